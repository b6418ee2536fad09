// Parts of a page that compares clips, whatever the answers are.

import { makeClip } from "./clip.js";

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in element && name !== "form" && typeof value !== "string") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

// A text with *emphasis*.
export const emphasised = (text) =>
  text.split(/\*([^*]+)\*/).map((part, i) => (i % 2 ? make("strong", {}, part) : part));

export function fail(error) {
  const note = document.getElementById("failure");
  note.textContent = `This study cannot go on: ${error.message}`;
  note.hidden = false;
}

// Clips of which one plays at a time. The message of an attention check is shown in the second half
// of the clip `checked`. `onEnd(i)` is called when clip i was played to its end.
export class Clips {
  constructor({ sides, message, checked }, names, onEnd) {
    this.clips = sides.map(makeClip);
    this.plays = sides.map(() => 0);
    this.names = names;
    this.onEnd = onEnd;
    this.message = message;
    this.checked = checked;
    this.notes = sides.map(() => make("p", { class: "message", hidden: true }, message));
    this.bars = sides.map(() => make("i"));
    this.buttons = names.map((name, i) => {
      const button = make("button", { class: "play", type: "button", disabled: true }, `Play ${name}`);
      button.addEventListener("click", () => this.play(i).catch(fail));
      return button;
    });
    this.started = performance.now();
  }

  // All clips of a trial last as long as the shortest one.
  async load() {
    this.seconds = Math.min(...(await Promise.all(this.clips.map((clip) => clip.load()))));
    this.unlock(false);
  }

  unlock(locked) {
    for (const button of this.buttons) button.disabled = locked;
  }

  async play(i) {
    this.stop();
    this.unlock(true);
    const screen = this.notes[i].parentElement;
    for (const note of this.notes) note.parentElement.classList.toggle("shown", note === this.notes[i]);
    screen.classList.add("playing");
    await this.clips[i].play(this.seconds, (time) => {
      this.bars[i].style.width = `${(100 * time) / this.seconds}%`;
      this.notes[i].hidden = !(this.message && i === this.checked && time > this.seconds / 2);
    });
    screen.classList.remove("playing");
    this.plays[i] += 1;
    this.unlock(false);
    this.buttons[i].textContent = `Play ${this.names[i]} again`;
    this.onEnd(i);
  }

  stop() {
    for (const clip of this.clips) clip.stop();
  }

  get taken() {
    return Number(((performance.now() - this.started) / 1000).toFixed(1));
  }
}

// A jsPsych plugin; a subclass has an async function `show(display, trial)`.
export class ClipTrial {
  constructor(jsPsych) {
    this.jsPsych = jsPsych;
  }

  // No async function: jsPsych would end the trial when its promise resolves.
  trial(display, trial) {
    this.show(display, trial).catch(fail);
  }
}

// The page of a trial: progress, question, the given parts, a hint and the button to go on.
export function layOut(display, trial, hint, go, ...parts) {
  display.replaceChildren(
    make("div", { class: "progress" }, make("i", { style: `width: ${(100 * trial.share).toFixed(1)}%` })),
    make("p", { class: "count" }, trial.progress),
    make("h1", { class: "question" }, ...emphasised(trial.question)),
    ...parts,
    make("div", { class: "foot" }, hint, go),
  );
  window.scrollTo(0, 0);
}

export const nextButton = () => make("button", { class: "next", type: "button", disabled: true }, "Continue");
