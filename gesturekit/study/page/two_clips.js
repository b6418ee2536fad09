// jsPsych plugin: two clips side by side, a question, five answers. The answers become active when
// both clips were played to their end.

import { ParameterType } from "jspsych";
import { ClipTrial, Clips, layOut, make, nextButton } from "./trial.js";

class TwoClips extends ClipTrial {
  static info = {
    name: "gesturekit-two-clips",
    version: "1",
    parameters: {
      sides: { type: ParameterType.COMPLEX },
      question: { type: ParameterType.STRING },
      answers: { type: ParameterType.COMPLEX },
      reasons: { type: ParameterType.COMPLEX, default: [] },
      message: { type: ParameterType.STRING, default: "" },
      checked: { type: ParameterType.INT, default: 1 },
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

  async show(display, trial) {
    let answer = null;
    const clips = new Clips(trial, ["left", "right"], () => {
      const ready = clips.plays.every((n) => n > 0);
      for (const choice of choices) choice.firstChild.disabled = !ready;
      if (ready && !answer) hint.textContent = "Choose an answer. You may play the clips again.";
    });
    const figures = clips.clips.map((clip, i) =>
      make("figure", { class: "clip" },
        make("figcaption", {}, i === 0 ? "Left" : "Right"),
        make("div", { class: "screen" }, clip.element, clips.notes[i]),
        make("div", { class: "bar" }, clips.bars[i]),
        clips.buttons[i]));
    const choices = trial.answers.map(({ code, text }) => {
      const input = make("input", { type: "radio", name: "answer", value: code, disabled: true });
      input.addEventListener("change", () => choose(code));
      return make("label", { class: "answer" }, input, make("span", {}, text));
    });
    const why = this.reasons(trial);
    const go = nextButton();
    const hint = make("p", { class: "hint", role: "status" }, "Play both clips to the end, then answer.");
    layOut(display, trial, hint, go,
      make("div", { class: "clips" }, ...figures),
      make("fieldset", { class: "answers" }, make("legend", {}, trial.question.replaceAll("*", "")), ...choices),
      why);

    function choose(code) {
      answer = code;
      why.hidden = !why.childElementCount || code === "TheyAreEqual";
      go.disabled = false;
      hint.textContent = "";
    }

    go.addEventListener("click", () => {
      clips.stop();
      const ticked = [...why.querySelectorAll("input:checked")].map((input) => input.value);
      this.jsPsych.finishTrial({
        answer,
        reasons: why.hidden ? [] : ticked,
        other: why.hidden ? "" : (why.querySelector("textarea")?.value.trim() ?? ""),
        seconds: clips.taken,
        plays: clips.plays,
      });
    });
    await clips.load();
  }

  reasons({ reasons }) {
    const boxes = reasons.map(({ code, text }) =>
      make("label", {}, make("input", { type: "checkbox", value: code }), make("span", {}, text)));
    const other = make("textarea", { rows: "2", maxlength: "1000", placeholder: "Other reasons, in your words", "aria-label": "Other reasons" });
    const parts = reasons.length ? [make("legend", {}, "Why? (choose any)"), ...boxes, other] : [];
    return make("fieldset", { class: "reasons", hidden: true }, ...parts);
  }
}

export default TwoClips;
