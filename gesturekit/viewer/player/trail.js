// Ghost trail: where a figure's hands were in the last second.

import { Color, InstancedMesh, Matrix4, MeshBasicMaterial, SphereGeometry } from "three";
import { point } from "./data.js";

const SECONDS = 1;
const BALLS = 24; // a hand
const PLACE = [0, 0, 0];
const MATRIX = new Matrix4();

export class Trail extends InstancedMesh {
  // Of a figure, on a page of this height in metres.
  constructor(figure, height) {
    const material = new MeshBasicMaterial({ color: new Color(figure.ink), transparent: true, opacity: 0.45 });
    super(new SphereGeometry(0.008 * height, 8, 6), material, BALLS * Math.max(1, figure.hands.length));
    this.figure = figure;
    this.frustumCulled = false;
    this.visible = false;
  }

  place(time) {
    if (!this.visible) return;
    this.figure.hands.forEach((hand, h) => {
      for (let k = 0; k < BALLS; k++) {
        const age = (k + 1) / BALLS;
        const [x, y, z] = point(this.figure, hand, time - age * SECONDS, PLACE);
        const size = time < age * SECONDS ? 0 : 1 - 0.8 * age;
        this.setMatrixAt(h * BALLS + k, MATRIX.makeScale(size, size, size).setPosition(x, y, z));
      }
    });
    this.count = BALLS * this.figure.hands.length;
    this.instanceMatrix.needsUpdate = true;
  }
}
