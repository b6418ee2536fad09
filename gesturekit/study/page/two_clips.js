// jsPsych plugin: two clips side by side, a question, five answers. The answers become active when
// both clips were played to their end.

import { ParameterType } from "jspsych";
import { makeClip } from "./clip.js";

const SIDES = ["left", "right"];

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

class TwoClips {
  static info = {
    name: "gesturekit-two-clips",
    version: "1",
    parameters: {
      sides: { type: ParameterType.COMPLEX },
      question: { type: ParameterType.STRING },
      answers: { type: ParameterType.COMPLEX },
      reasons: { type: ParameterType.COMPLEX, default: [] },
      message: { type: ParameterType.STRING, default: "" },
      progress: { type: ParameterType.STRING, default: "" },
      share: { type: ParameterType.FLOAT, default: 0 },
    },
    data: {
      answer: { type: ParameterType.STRING },
      reasons: { type: ParameterType.STRING, array: true },
      other: { type: ParameterType.STRING },
      seconds: { type: ParameterType.FLOAT },
      plays: { type: ParameterType.INT, array: true },
    },
  };

  constructor(jsPsych) {
    this.jsPsych = jsPsych;
  }

  // No async function: jsPsych would end the trial when its promise resolves.
  trial(display, trial) {
    this.show(display, trial).catch(this.fail);
  }

  async show(display, trial) {
    const started = performance.now();
    const clips = trial.sides.map(makeClip);
    const plays = [0, 0];
    let answer = null;
    let seconds = 0;

    const notes = clips.map(() => make("p", { class: "message", hidden: true }, trial.message));
    const bars = clips.map(() => make("i"));
    const buttons = SIDES.map((side) => make("button", { class: "play", type: "button", disabled: true }, `Play ${side}`));
    const figures = clips.map((clip, i) =>
      make("figure", { class: "clip" },
        make("figcaption", {}, SIDES[i] === "left" ? "Left" : "Right"),
        make("div", { class: "screen" }, clip.element, notes[i]),
        make("div", { class: "bar" }, bars[i]),
        buttons[i]));

    const choices = trial.answers.map(({ code, text }) => {
      const input = make("input", { type: "radio", name: "answer", value: code, disabled: true });
      input.addEventListener("change", () => choose(code));
      return make("label", { class: "answer" }, input, make("span", {}, text));
    });
    const why = this.reasons(trial);
    const go = make("button", { class: "next", type: "button", disabled: true }, "Continue");
    const hint = make("p", { class: "hint", role: "status" }, "Play both clips to the end, then answer.");
    display.replaceChildren(
      make("div", { class: "progress" }, make("i", { style: `width: ${(100 * trial.share).toFixed(1)}%` })),
      make("p", { class: "count" }, trial.progress),
      make("h1", { class: "question" }, ...emphasised(trial.question)),
      make("div", { class: "clips" }, ...figures),
      make("fieldset", { class: "answers" }, make("legend", {}, trial.question.replaceAll("*", "")), ...choices),
      why,
      make("div", { class: "foot" }, hint, go),
    );
    window.scrollTo(0, 0);

    function choose(code) {
      answer = code;
      why.hidden = !why.childElementCount || code === "TheyAreEqual";
      go.disabled = false;
      hint.textContent = "";
    }

    const allow = () => {
      const ready = plays.every((n) => n > 0);
      for (const choice of choices) choice.firstChild.disabled = !ready;
      if (ready && !answer) hint.textContent = "Choose an answer. You may play the clips again.";
    };

    const play = async (i) => {
      clips[1 - i].stop();
      for (const button of buttons) button.disabled = true;
      figures[i].classList.add("playing");
      // The message of an attention check is shown in the second half of the second clip.
      await clips[i].play(seconds, (time) => {
        bars[i].style.width = `${(100 * time) / seconds}%`;
        notes[i].hidden = !(trial.message && i === 1 && time > seconds / 2);
      });
      figures[i].classList.remove("playing");
      plays[i] += 1;
      for (const button of buttons) button.disabled = false;
      buttons[i].textContent = `Play ${SIDES[i]} again`;
      allow();
    };
    buttons.forEach((button, i) => button.addEventListener("click", () => play(i).catch(this.fail)));

    go.addEventListener("click", () => {
      for (const clip of clips) clip.stop();
      const ticked = [...why.querySelectorAll("input:checked")].map((input) => input.value);
      this.jsPsych.finishTrial({
        answer,
        reasons: why.hidden ? [] : ticked,
        other: why.hidden ? "" : (why.querySelector("textarea")?.value.trim() ?? ""),
        seconds: Number(((performance.now() - started) / 1000).toFixed(1)),
        plays,
      });
    });

    seconds = Math.min(...(await Promise.all(clips.map((clip) => clip.load()))));
    for (const button of buttons) button.disabled = false;
  }

  reasons({ reasons }) {
    const boxes = reasons.map(({ code, text }) =>
      make("label", {}, make("input", { type: "checkbox", value: code }), make("span", {}, text)));
    const other = make("textarea", { rows: "2", maxlength: "1000", placeholder: "Other reasons, in your words", "aria-label": "Other reasons" });
    const parts = reasons.length ? [make("legend", {}, "Why? (choose any)"), ...boxes, other] : [];
    return make("fieldset", { class: "reasons", hidden: true }, ...parts);
  }

  fail(error) {
    const note = document.getElementById("failure");
    note.textContent = `This study cannot go on: ${error.message}`;
    note.hidden = false;
  }
}

export default TwoClips;
