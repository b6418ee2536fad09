/*!
 * Holds jsPsych 8 (https://www.jspsych.org), Copyright (c) Joshua R. de Leeuw and contributors;
 * seedrandom, Copyright (c) 2019 David Bau; random-words, Copyright (c) Apostrophe
 * Technologies; auto-bind, Copyright (c) Sindre Sorhus; all MIT:
 * Permission is hereby granted, free of charge, to any person obtaining a copy of this software and
 * associated documentation files (the "Software"), to deal in the Software without restriction,
 * including without limitation the rights to use, copy, modify, merge, publish, distribute,
 * sublicense, and/or sell copies of the Software, and to permit persons to whom the Software is
 * furnished to do so, subject to the following conditions: The above copyright notice and this
 * permission notice shall be included in all copies or substantial portions of the Software. THE
 * SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT
 * LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND
 * NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM,
 * DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT
 * OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
 */
// The page that gesturekit/study/build.py writes. URL parameters: PROLIFIC_PID (or user), STUDY_ID,
// SESSION_ID, list.

import { initJsPsych } from "jspsych";
import { download, post, toCsv } from "./results.js";
import Sliders from "./sliders.js";
import { soundCheck } from "./sound_check.js";
import { emphasised, make } from "./trial.js";
import TwoClips from "./two_clips.js";

const setup = JSON.parse(document.getElementById("setup").textContent);
const parameters = new URLSearchParams(location.search);
const given = (name) =>
  (parameters.get(name) ?? "").replace(/[^\p{L}\p{M}\p{N}_ .@:-]/gu, "").trim().slice(0, 100);

function randomName() {
  const bytes = crypto.getRandomValues(new Uint8Array(8));
  return `r${[...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("")}`;
}

// FNV-1a: raters without a list of their own are spread over the lists by their names.
function hash(text) {
  let value = 0x811c9dc5;
  for (const unit of text) value = Math.imul(value ^ unit.codePointAt(0), 0x01000193) >>> 0;
  return value;
}

const user = given("PROLIFIC_PID") || given("user") || randomName();
const asked = Number.parseInt(given("list"), 10);
const list = Number.isInteger(asked) && asked >= 1
  ? (asked - 1) % setup.lists.length
  : hash(`${setup.seed} ${user}`) % setup.lists.length;
const rater = {
  user,
  study: setup.name,
  list: list + 1,
  study_id: given("STUDY_ID"),
  session_id: given("SESSION_ID"),
};

const jsPsych = initJsPsych({ display_element: "study", override_safe_mode: true });
jsPsych.randomization.setSeed(`${setup.seed} ${user}`);
const { shuffle } = jsPsych.randomization;

class Screen {
  static info = {
    name: "gesturekit-screen",
    version: "1",
    parameters: { build: { type: "FUNCTION" } },
    data: {},
  };

  constructor(psych) { this.psych = psych; }

  trial(display, { build }) {
    display.replaceChildren(make("div", { class: "page" }, ...build((data = {}) => this.psych.finishTrial(data))));
    window.scrollTo(0, 0);
  }
}

// jsPsych would call a function that is a parameter: it is wrapped once.
const screen = (build) => ({ type: Screen, build: () => build });
const paragraphs = (text) => text.split(/\n\s*\n/).map((part) => make("p", {}, ...emphasised(part.trim())));

function button(text, act) {
  const element = make("button", { class: "next", type: "button" }, text);
  element.addEventListener("click", act);
  return element;
}

function welcome(next) {
  const parts = [make("h1", {}, setup.title), ...paragraphs(setup.introduction)];
  const start = button("Start", next);
  if (!setup.consent) return [...parts, start];
  const agree = make("input", { type: "checkbox" });
  start.disabled = true;
  agree.addEventListener("change", () => { start.disabled = !agree.checked; });
  return [...parts, make("label", { class: "consent" }, agree, make("span", {}, ...emphasised(setup.consent))), start];
}

const styleScreen = (style, question) =>
  screen((next) => [make("h1", {}, "Next part"), make("p", {}, "From here on, the question is:"),
    make("p", { class: "question" }, ...emphasised(question)), button("Continue", next)]);

// Comparisons in the order of this rater: styles in their order, shuffled within.
function ordered(trials) {
  const groups = setup.styles.length ? setup.styles.map(({ name }) => trials.filter((t) => t.style === name)) : [trials];
  return groups.map((group) => shuffle(group).map(inOrder));
}

// Sliders stand in another order on each page; the sides of a pair are those of the list.
function inOrder(trial) {
  if (!setup.scale) return trial;
  const order = shuffle(trial.sides.map((_, i) => i));
  return { ...trial, systems: order.map((i) => trial.systems[i]), sides: order.map((i) => trial.sides[i]) };
}

// An attention check shows a comparison again that was seen before. It is never the first.
function withChecks(groups) {
  const flat = groups.flat();
  const places = shuffle(flat.slice(1).map((_, i) => i + 1)).slice(0, setup.checks);
  return groups.map((group) => group.flatMap((trial) => {
    const place = flat.indexOf(trial);
    if (!places.includes(place)) return [trial];
    const [shown = trial] = shuffle(flat.slice(0, place).filter(({ style }) => style === trial.style));
    return [check(shown), trial];
  }));
}

function check(shown) {
  if (setup.scale) {
    const [expected] = shuffle([10, 20, 30, 70, 80, 90]);
    const [checked] = shuffle(shown.sides.map((_, i) => i));
    return { ...shown, expected, checked, message: `Attention: please set the slider of this clip to ${expected}.` };
  }
  const { code, text } = shuffle(setup.answers.filter((answer) => answer.code !== "TheyAreEqual"))[0];
  return { ...shown, expected: code, checked: 1, message: `Attention: please select “${text}”.` };
}

function timeline() {
  const own = setup.lists[list];
  const groups = withChecks(ordered(own));
  const count = groups.flat().length;
  const parts = [screen(welcome)];
  if (setup.sound) parts.push(screen((next) => soundCheck(next, shuffle)));
  if (setup.practice) {
    // Not of a segment that this rater is asked about, if there is another.
    const seen = new Set(own.map(({ clip }) => clip));
    const other = setup.lists.flat().find(({ clip }) => !seen.has(clip)) ?? own[0];
    parts.push(page(inOrder(other), { progress: "Practice: this answer does not count", share: 0, data: {} }));
    parts.push(screen((next) => [make("h1", {}, "That was the practice"), make("p", {}, "The study begins now."), button("Continue", next)]));
  }
  let done = 0;
  for (const group of groups) {
    const style = setup.styles.find(({ name }) => name === group[0]?.style);
    if (style && group.length) parts.push(styleScreen(style, style.question));
    for (const trial of group) {
      const { clip, systems, expected, checked } = trial;
      const data = { compared: true, clip, systems, style: trial.style ?? "", question: setup.question.replaceAll("*", "") };
      if (expected !== undefined) Object.assign(data, { expected, checked });
      parts.push(page(trial, { progress: `${done + 1} of ${count}`, share: done / count, data }));
      done += 1;
    }
  }
  return [...parts, screen(comments)];
}

// The page of one comparison.
function page(trial, settings) {
  const question = setup.styles.find(({ name }) => name === trial.style)?.question ?? setup.question;
  const shown = { sides: trial.sides, question, message: trial.message ?? "", checked: trial.checked ?? 0, ...settings };
  if (setup.scale) return { type: Sliders, scale: setup.scale, ...shown };
  return { type: TwoClips, answers: setup.answers, reasons: trial.expected ? [] : setup.reasons, ...shown };
}

function comments(next) {
  const text = make("textarea", { rows: "5", maxlength: String(setup.comment), "aria-label": "Comments" });
  return [make("h1", {}, "Any comments?"), make("p", {}, "Did anything look odd, or not work? You may leave this empty."), text,
    button("Finish", () => next({ comment: text.value.trim() }))];
}

function endScreen(text, saved) {
  const again = button("Download the answers", () => download(text, fileName()));
  const parts = [make("h1", {}, "Thank you!")];
  if (saved) parts.push(make("p", {}, "Your answers were sent."));
  else parts.push(make("p", {}, "Your answers are in a file that was downloaded. Please give it to whoever asked you to take part."), again);
  if (setup.completion) parts.push(make("p", {}, make("a", { class: "next", href: setup.completion }, "Finish")));
  document.getElementById("study").replaceChildren(make("div", { class: "page" }, ...parts));
  document.documentElement.dataset.study = saved ? "sent" : "downloaded";
}

const fileName = () => `${setup.name}_${user}.csv`.replace(/[^\p{L}\p{M}\p{N}_.@-]+/gu, "_");

async function finish() {
  const trials = jsPsych.data.get().filter({ compared: true }).values();
  const { comment } = jsPsych.data.get().last(1).values()[0];
  const text = toCsv({ ...rater, comment, finished: new Date().toISOString() }, trials);
  let saved = false;
  if (setup.post) {
    try {
      await post(text, setup.post);
      saved = true;
    } catch {
      // The answers must not be lost: they are downloaded instead.
    }
  }
  if (!saved) download(text, fileName());
  window.removeEventListener("beforeunload", warn);
  endScreen(text, saved);
}

function warn(event) {
  event.preventDefault();
}

window.addEventListener("beforeunload", warn);
jsPsych.run(timeline()).then(finish);
