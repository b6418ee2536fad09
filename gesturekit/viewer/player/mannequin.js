// Limbs and head of a figure as one mesh: each vertex moves with one bone, so that a body of any
// number of joints is one draw call. What is drawn where is decided in gesturekit/viewer/figure.py.

import { BufferAttribute, Color, LatheGeometry, Matrix4, SphereGeometry, Vector2, Vector3 } from "three";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";
import { Skinned } from "./skinned.js";

// Steps along the arc at each end and around a limb that is thick or thin; around and along a ball.
// A coarse limb begins a little thinner, so that the end of the one before it covers its corners.
const FINE = { thick: [8, 24], thin: [4, 10], ball: [40, 28], eye: [16, 12], start: 1 };
const COARSE = { thick: [3, 10], thin: [1, 5], ball: [14, 10], eye: [6, 4], start: 0.93 };

// Head in units of its height: sizes and place of each ball. Its joint is at the origin, its face
// towards +Z.
const BALLS = [
  [0.34, 0.46, 0.41, 0, 0.4, 0.06],
  [0.235, 0.27, 0.26, 0, 0.16, 0.11],
  [0.045, 0.1, 0.07, 0, 0.3, 0.46],
];
const EYES = [-1, 1].map((side) => [0.034, 0.045, 0.02, side * 0.125, 0.41, 0.43]);
const EYE_INK = "#2b3440";

const X = new Vector3();
const Y = new Vector3();
const Z = new Vector3();
const A = new Vector3();
const B = new Vector3();

// A limb along +Y from 0 to its length, round at both ends.
function limb({ radii, width, length }, height, detail) {
  const [start, end] = [radii[0] * detail.start, radii[1]];
  const profile = [];
  const isThick = Math.max(...radii) > 0.012 * height;
  const [arc, around] = isThick ? detail.thick : detail.thin;
  // Where the ends' spheres meet the cone between them without a crease.
  const lean = Math.asin(Math.min(Math.max((start - end) / Math.max(length, 1e-6 * height), -0.95), 0.95));
  for (let i = 0; i <= arc; i++) {
    const a = -Math.PI / 2 + ((Math.PI / 2 + lean) * i) / arc;
    profile.push(new Vector2(Math.max(1e-5 * height, Math.cos(a) * start), Math.sin(a) * start));
  }
  for (let i = 0; i <= arc; i++) {
    const a = lean + ((Math.PI / 2 - lean) * i) / arc;
    profile.push(new Vector2(Math.max(1e-5 * height, Math.cos(a) * end), length + Math.sin(a) * end));
  }
  return new LatheGeometry(profile, around).scale(width, 1, 1);
}

function ball([sx, sy, sz, x, y, z], size, [around, high]) {
  return new SphereGeometry(1, around, high).scale(sx * size, sy * size, sz * size).translate(x * size, y * size, z * size);
}

// Give a part's vertices its bone and its colour.
function owned(part, bone, hex) {
  const { count } = part.attributes.position;
  const filled = (values) => Array.from({ length: count }, () => values).flat();
  part.deleteAttribute("uv");
  part.setAttribute("skinIndex", new BufferAttribute(new Uint16Array(filled([bone, 0, 0, 0])), 4));
  part.setAttribute("skinWeight", new BufferAttribute(new Uint8Array(filled([255, 0, 0, 0])), 4, true));
  part.setAttribute("color", new BufferAttribute(new Float32Array(filled(new Color(hex).toArray())), 3));
  return part;
}

function whole({ limbs, head }, sides, height, detail) {
  const parts = limbs.map((each, i) => owned(limb(each, height, detail), i, sides[each.side]));
  if (head) {
    const add = (steps, hex) => (shape) => parts.push(owned(ball(shape, head.size, steps), limbs.length, hex));
    BALLS.forEach(add(detail.ball, sides[0]));
    EYES.forEach(add(detail.eye, EYE_INK));
  }
  return mergeGeometries(parts);
}

export class Mannequin extends Skinned {
  // Of a figure on a page of this height, metres; `sides` are the colours of its middle, left, right.
  constructor(figure, material, sides, height) {
    super();
    this.figure = figure;
    const count = figure.limbs.length + (figure.head ? 1 : 0);
    const shapes = count ? [FINE, COARSE].map((detail) => whole(figure, sides, height, detail)) : [];
    this.bind(shapes, material, Array.from({ length: count }, () => new Matrix4()), count > 0);
  }

  // Points as data.js' `pose` fills them.
  place(points) {
    this.figure.limbs.forEach(({ ends, across, length }, i) => {
      point(points, ends[0], A);
      Y.subVectors(point(points, ends[1], B), A);
      const real = Y.length();
      if (real > 1e-9) Y.divideScalar(real);
      else Y.set(0, 1, 0);
      // Any axis will do around a round limb; a flat one lies along the line `across`.
      if (across) X.subVectors(point(points, across[1], X), point(points, across[0], Z));
      else X.set(Math.abs(Y.x) < 0.9 ? 1 : 0, Math.abs(Y.x) < 0.9 ? 0 : 1, 0);
      X.addScaledVector(Y, -X.dot(Y));
      if (X.lengthSq() < 1e-12) X.set(1, 0, 0);
      X.normalize();
      Z.crossVectors(X, Y);
      this.set(i, A, X, Y.multiplyScalar(real / length || 1), Z);
    });
    const { head, limbs } = this.figure;
    if (!head) return;
    point(points, head.base, A);
    Y.subVectors(point(points, head.up, B), A).normalize();
    Z.subVectors(point(points, head.face, B), A);
    Z.addScaledVector(Y, -Z.dot(Y)).normalize();
    X.crossVectors(Y, Z);
    this.set(limbs.length, A, X, Y, Z);
  }

  set(bone, place, x, y, z) {
    this.bones[bone].matrix.makeBasis(x, y, z).setPosition(place);
    this.bones[bone].matrixWorldNeedsUpdate = true;
  }
}

function point(points, index, out) {
  return out.set(points[index * 3], points[index * 3 + 1], points[index * 3 + 2]);
}
