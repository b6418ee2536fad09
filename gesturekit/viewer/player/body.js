// A figure made of tapered limbs, or a body's skin where the page has one. What is drawn where is
// decided in gesturekit/viewer/figure.py.

import {
  Color, Group, LatheGeometry, Matrix4, Mesh, MeshLambertMaterial, SphereGeometry, Vector2, Vector3,
} from "three";
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

const X = new Vector3();
const Y = new Vector3();
const Z = new Vector3();
const A = new Vector3();
const B = new Vector3();
const FRAME = new Matrix4();

// A limb along +Y from 0 to `length`, round at both ends.
function limb(length, start, end, height) {
  const profile = [];
  const isThick = Math.max(start, end) > 0.012 * height;
  const arc = isThick ? 8 : 4;
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
  return new LatheGeometry(profile, isThick ? 24 : 10);
}

export class Body extends Group {
  // Of a figure on a page of this height, metres.
  constructor(figure, index, height) {
    super();
    this.figure = figure;
    this.points = new Float32Array(figure.channels);
    const palette = figure.ink ? shades(figure.ink) : PALETTES[index % PALETTES.length];
    figure.ink = palette.ink;
    const material = (colour) => new MeshLambertMaterial({ color: new Color(colour) });
    this.trail = new Trail(figure, height);
    this.add(this.trail);
    if (figure.skin) {
      this.bones = [];
      this.skin = new Skin(figure, material(palette.middle));
      this.add(this.skin);
      return;
    }
    const skins = [material(palette.middle), material(palette.left), material(palette.right)];
    this.bones = figure.limbs.map(({ ends, radii, side, across, width, length }) => {
      const mesh = new Mesh(limb(length, radii[0], radii[1], height), skins[side]);
      return { mesh, ends, across, width, length };
    });
    for (const { mesh } of this.bones) this.addLimb(mesh);
    if (figure.head) this.addHead(figure.head, skins[0], material("#2b3440"));
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

  addLimb(mesh) {
    mesh.castShadow = mesh.receiveShadow = true;
    mesh.matrixAutoUpdate = false;
    mesh.frustumCulled = false;
    this.add(mesh);
  }

  addHead({ base, up, face, size }, skin, ink) {
    const head = new Group();
    head.matrixAutoUpdate = false;
    const ball = (sx, sy, sz, x, y, z, material) => {
      const mesh = new Mesh(new SphereGeometry(1, 40, 28), material);
      mesh.scale.set(sx * size, sy * size, sz * size);
      mesh.position.set(x * size, y * size, z * size);
      mesh.castShadow = mesh.receiveShadow = true;
      head.add(mesh);
    };
    // In units of the head's height; its joint is at the origin, its face towards +Z.
    ball(0.34, 0.46, 0.41, 0, 0.4, 0.06, skin);
    ball(0.235, 0.27, 0.26, 0, 0.16, 0.11, skin);
    ball(0.045, 0.1, 0.07, 0, 0.3, 0.46, skin);
    for (const side of [-1, 1]) ball(0.034, 0.045, 0.02, side * 0.125, 0.41, 0.43, ink);
    this.head = { group: head, base, up, face };
    this.add(head);
  }

  point(points, index, out) {
    return out.set(points[index * 3], points[index * 3 + 1], points[index * 3 + 2]);
  }

  // Points as data.js' `pose` fills them, at `time` seconds.
  place(points, time) {
    this.skin?.place(points, time);
    this.trail.place(time);
    for (const { mesh, ends, across, width, length } of this.bones) {
      this.point(points, ends[0], A);
      this.point(points, ends[1], B);
      Y.subVectors(B, A);
      const real = Y.length();
      if (real > 1e-9) Y.divideScalar(real);
      else Y.set(0, 1, 0);
      // Any axis will do around a round limb; a flat one lies along the line `across`.
      if (across) X.subVectors(this.point(points, across[1], X), this.point(points, across[0], Z));
      else X.set(Math.abs(Y.x) < 0.9 ? 1 : 0, Math.abs(Y.x) < 0.9 ? 0 : 1, 0);
      X.addScaledVector(Y, -X.dot(Y));
      if (X.lengthSq() < 1e-12) X.set(1, 0, 0);
      X.normalize();
      Z.crossVectors(X, Y);
      FRAME.makeBasis(X.multiplyScalar(width), Y.multiplyScalar(real / length || 1), Z);
      mesh.matrix.copy(FRAME.setPosition(A));
    }
    if (this.head) this.placeHead(points);
  }

  placeHead(points) {
    const { group, base, up, face } = this.head;
    this.point(points, base, A);
    Y.subVectors(this.point(points, up, B), A).normalize();
    Z.subVectors(this.point(points, face, B), A);
    Z.addScaledVector(Y, -Z.dot(Y)).normalize();
    X.crossVectors(Y, Z);
    group.matrix.makeBasis(X, Y, Z).setPosition(A);
    group.matrixWorldNeedsUpdate = true;
  }
}
