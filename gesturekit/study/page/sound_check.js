// A screen on which raters choose how many tones they hear: nobody rates without sound by mistake.

import { make } from "./trial.js";

const CHOICES = [2, 3, 4, 5];

function play(count) {
  const context = new AudioContext();
  const gain = new GainNode(context, { gain: 0.25 });
  gain.connect(context.destination);
  for (let i = 0; i < count; i += 1) {
    const tone = new OscillatorNode(context, { frequency: 440 });
    tone.connect(gain);
    const start = context.currentTime + 0.1 + 0.4 * i;
    tone.start(start);
    tone.stop(start + 0.2);
  }
  return new Promise((resolve) => setTimeout(() => context.close().then(resolve), 300 + 400 * count));
}

export function soundCheck(next, shuffle) {
  let [count] = shuffle(CHOICES);
  const hint = make("p", { class: "hint", role: "status" }, "");
  const start = make("button", { class: "play", type: "button" }, "Play the tones");
  const go = make("button", { class: "next", type: "button", disabled: true }, "Continue");
  const choices = [...CHOICES.map(String), "none"].map((text) => {
    const input = make("input", { type: "radio", name: "tones", value: text, disabled: true });
    input.addEventListener("change", () => { go.disabled = false; });
    return make("label", { class: "answer" }, input, make("span", {}, text));
  });
  const inputs = choices.map((choice) => choice.firstChild);
  const lock = (locked) => { for (const input of inputs) Object.assign(input, { disabled: locked, checked: false }); };
  start.addEventListener("click", () => {
    start.disabled = true;
    play(count).then(() => { start.disabled = false; lock(false); });
  });
  go.addEventListener("click", () => {
    if (inputs.find((input) => input.checked)?.value === String(count)) {
      next();
      return;
    }
    [count] = shuffle(CHOICES);
    lock(true);
    go.disabled = true;
    hint.textContent = "That was another number. Turn the sound on, and play the tones again: there may be more or fewer.";
  });
  return [make("h1", {}, "Can you hear the sound?"),
    make("p", {}, "Play the tones, and choose how many you hear."), start,
    make("fieldset", { class: "answers" }, make("legend", {}, "Number of tones"), ...choices), hint, go];
}
