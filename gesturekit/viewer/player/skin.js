// A body's skin, moved by the joints and the face of its figure: linear blend skinning and morphs,
// done by three.js.

import { BufferAttribute, BufferGeometry, Color, Matrix4, Quaternion, Vector3 } from "three";
import { mixed } from "./data.js";
import { Skinned } from "./skinned.js";

const ONE = new Vector3(1, 1, 1);
const PLACE = new Vector3();
const TURN = new Quaternion();

// Colours of vertices (RGB) from the regions of the surface that they belong to.
function colours(regions, palette) {
  const rgb = palette.map((hex) => new Color(hex).toArray());
  return new BufferAttribute(Float32Array.from([...regions].flatMap((region) => rgb[region])), 3);
}

// How the normals of a shape change when its vertices move.
function tilt(shape, moves) {
  const moved = new BufferGeometry().setIndex(shape.index);
  const places = shape.attributes.position.array.map((x, i) => x + moves[i]);
  moved.setAttribute("position", new BufferAttribute(places, 3));
  moved.computeVertexNormals();
  const before = shape.attributes.normal.array;
  return new BufferAttribute(moved.attributes.normal.array.map((x, i) => x - before[i]), 3);
}

function geometry({ vertices, faces, joints, weights, regions, morphs }, palette) {
  const shape = new BufferGeometry();
  shape.setAttribute("position", new BufferAttribute(vertices, 3));
  shape.setAttribute("skinIndex", new BufferAttribute(joints, 4));
  shape.setAttribute("skinWeight", new BufferAttribute(weights, 4, true));
  if (regions) shape.setAttribute("color", colours(regions, palette));
  shape.setIndex(new BufferAttribute(faces, 1));
  shape.computeVertexNormals();
  if (morphs?.length) {
    shape.morphTargetsRelative = true;
    shape.morphAttributes.position = morphs.map((moves) => new BufferAttribute(moves, 3));
    shape.morphAttributes.normal = morphs.map((moves) => tilt(shape, moves));
  }
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
    const { turns, face } = this.figure.skin;
    mixed(this.figure, turns, time, this.turns);
    if (face) mixed(this.figure, face, time, this.levels[0].morphTargetInfluences);
    this.bones.forEach((bone, j) => {
      PLACE.fromArray(points, 3 * j);
      bone.matrix.compose(PLACE, TURN.fromArray(this.turns, 4 * j).normalize(), ONE);
      bone.matrixWorldNeedsUpdate = true;
    });
  }
}
