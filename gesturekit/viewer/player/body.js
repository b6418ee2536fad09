// A figure's body: a mannequin of limbs, or a skin where the page has one; and its hands' trail.

import { Color, Group, MeshLambertMaterial } from "three";
import { Mannequin } from "./mannequin.js";
import { Skin } from "./skin.js";
import { Trail } from "./trail.js";

// One palette a figure: the middle of the body, its left, its right, and its ink on the strip.
const PALETTES = [
  { middle: "#e9e4da", left: "#e88a62", right: "#5d97bf", ink: "#c8643a" },
  { middle: "#dfe6e1", left: "#c9a227", right: "#5b9a7b", ink: "#3d7d5e" },
  { middle: "#e6e0ea", left: "#c9719a", right: "#7b73b8", ink: "#6a5fae" },
  { middle: "#e2e2e2", left: "#9a8f80", right: "#6f7f8f", ink: "#57616c" },
];

// The palette of a figure whose colour the page gives: the limbs are lighter shades of it.
function shades(ink) {
  const mixed = (share) => `#${new Color(ink).lerp(new Color("#ffffff"), share).getHexString()}`;
  return { middle: mixed(0.72), left: mixed(0.2), right: mixed(0.45), ink };
}

export class Body extends Group {
  // Of a figure on a page of this height, metres.
  constructor(figure, index, height) {
    super();
    this.figure = figure;
    this.points = new Float32Array(figure.channels);
    const { middle, left, right, ink } = figure.ink ? shades(figure.ink) : PALETTES[index % PALETTES.length];
    figure.ink = ink;
    const material = new MeshLambertMaterial({ color: new Color(middle) });
    this.trail = new Trail(figure, height);
    this.shape = figure.skin ? new Skin(figure, material) : new Mannequin(figure, material, [middle, left, right], height);
    this.add(this.trail, this.shape);
  }

  // Let what is behind shine through, or not.
  setTransparent(transparent) {
    this.traverse(({ material }) => {
      if (!material || material === this.trail.material) return;
      material.transparent = transparent;
      material.opacity = transparent ? 0.55 : 1;
      material.needsUpdate = true;
    });
  }

  // Points as data.js' `pose` fills them, at `time` seconds.
  place(points, time) {
    this.shape.place(points, time);
    this.trail.place(time);
  }
}
