// jsPsych plugin: clips of several systems, each with a slider from 0 to 100 (HEMVIP). One clip is seen
// at a time; a slider becomes active when its clip was played to its end.

import { ParameterType } from "jspsych";
import { ClipTrial, Clips, layOut, make, nextButton } from "./trial.js";

class Sliders extends ClipTrial {
  static info = {
    name: "gesturekit-sliders",
    version: "1",
    parameters: {
      sides: { type: ParameterType.COMPLEX },
      question: { type: ParameterType.STRING },
      scale: { type: ParameterType.STRING, array: true },
      message: { type: ParameterType.STRING, default: "" },
      checked: { type: ParameterType.INT, default: 0 },
      progress: { type: ParameterType.STRING, default: "" },
      share: { type: ParameterType.FLOAT, default: 0 },
    },
    data: {
      values: { type: ParameterType.INT, array: true },
      seconds: { type: ParameterType.FLOAT },
      plays: { type: ParameterType.INT, array: true },
    },
  };

  async show(display, trial) {
    const values = trial.sides.map(() => null);
    const clips = new Clips(trial, trial.sides.map((_, i) => `${i + 1}`), (i) => {
      sliders[i].disabled = false;
      hint.textContent = "Rate each clip with its slider. You may play the clips again.";
    });
    const outputs = values.map(() => make("output", {}, "–"));
    const sliders = values.map((_, i) => {
      const slider = make("input", { type: "range", min: "0", max: "100", value: "50", class: "unrated", disabled: true,
        "aria-label": `Rating of clip ${i + 1}` });
      const rate = () => {
        values[i] = Number(slider.value);
        outputs[i].textContent = slider.value;
        slider.classList.remove("unrated");
        go.disabled = values.includes(null);
      };
      // A click on the middle is a rating too, and changes nothing.
      for (const event of ["input", "pointerup", "keyup"]) slider.addEventListener(event, () => slider.disabled || rate());
      return slider;
    });
    const screens = clips.clips.map((clip, i) => make("div", { class: `screen ${i ? "" : "shown"}` }, clip.element, clips.notes[i]));
    const rows = values.map((_, i) => make("div", { class: "row" },
      make("div", {}, clips.buttons[i], make("div", { class: "bar" }, clips.bars[i])), sliders[i], outputs[i]));
    const go = nextButton();
    const hint = make("p", { class: "hint", role: "status" }, "Play each clip to the end, then rate it.");
    const scale = make("div", { class: "row scale" }, make("span"),
      make("p", {}, ...trial.scale.map((word) => make("span", {}, word))), make("span"));
    layOut(display, trial, hint, go, make("div", { class: "sliders" },
      make("div", { class: "stack" }, ...screens), make("div", { class: "rows" }, scale, ...rows)));

    go.addEventListener("click", () => {
      clips.stop();
      this.jsPsych.finishTrial({ values, seconds: clips.taken, plays: clips.plays });
    });
    await clips.load();
  }
}

export default Sliders;
