// A body's skin, moved by the joints of its figure: linear blend skinning, done by three.js.

import { BufferAttribute, BufferGeometry, Color, Matrix4, Quaternion, Vector3 } from "three";
import { turns } from "./data.js";
import { Skinned } from "./skinned.js";

const ONE = new Vector3(1, 1, 1);
const PLACE = new Vector3();
const TURN = new Quaternion();

// Colours of vertices (RGB) from the regions of the surface that they belong to.
function colours(regions, palette) {
  const rgb = palette.map((hex) => new Color(hex).toArray());
  return new BufferAttribute(Float32Array.from([...regions].flatMap((region) => rgb[region])), 3);
}

function geometry({ vertices, faces, joints, weights, regions }, palette) {
  const shape = new BufferGeometry();
  shape.setAttribute("position", new BufferAttribute(vertices, 3));
  shape.setAttribute("skinIndex", new BufferAttribute(joints, 4));
  shape.setAttribute("skinWeight", new BufferAttribute(weights, 4, true));
  if (regions) shape.setAttribute("color", colours(regions, palette));
  shape.setIndex(new BufferAttribute(faces, 1));
  shape.computeVertexNormals();
  return shape;
}

export class Skin extends Skinned {
  constructor(figure, material) {
    super();
    const { levels, palette, rest } = figure.skin;
    const inverses = [];
    for (let j = 0; j < rest.length / 3; j++) {
      inverses.push(new Matrix4().makeTranslation(-rest[3 * j], -rest[3 * j + 1], -rest[3 * j + 2]));
    }
    this.figure = figure;
    this.turns = new Float32Array(4 * inverses.length);
    this.bind(levels.map((level) => geometry(level, palette)), material, inverses, Boolean(palette));
  }

  // Each joint carries its frame to the world; the figure's first points are its joints.
  place(points, time) {
    turns(this.figure, time, this.turns);
    this.bones.forEach((bone, j) => {
      PLACE.fromArray(points, 3 * j);
      bone.matrix.compose(PLACE, TURN.fromArray(this.turns, 4 * j).normalize(), ONE);
      bone.matrixWorldNeedsUpdate = true;
    });
  }
}
