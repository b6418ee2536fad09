// A body's skin, moved by the joints of its figure: linear blend skinning, done by three.js.

import {
  Bone, BufferAttribute, BufferGeometry, Matrix4, Quaternion, Skeleton, SkinnedMesh, Vector3,
} from "three";
import { turns } from "./data.js";

const ONE = new Vector3(1, 1, 1);
const PLACE = new Vector3();
const TURN = new Quaternion();

export class Skin extends SkinnedMesh {
  constructor(figure, material) {
    const { vertices, faces, joints, weights, rest } = figure.skin;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(vertices, 3));
    geometry.setAttribute("skinIndex", new BufferAttribute(joints, 4));
    geometry.setAttribute("skinWeight", new BufferAttribute(weights, 4, true));
    geometry.setIndex(new BufferAttribute(faces, 1));
    geometry.computeVertexNormals();
    super(geometry, material);
    const bones = [];
    const inverses = [];
    for (let j = 0; j < rest.length / 3; j++) {
      const bone = new Bone();
      bone.matrixAutoUpdate = false;
      bones.push(bone);
      inverses.push(new Matrix4().makeTranslation(-rest[3 * j], -rest[3 * j + 1], -rest[3 * j + 2]));
    }
    this.figure = figure;
    this.turns = new Float32Array(4 * bones.length);
    this.castShadow = this.receiveShadow = true;
    this.frustumCulled = false;
    this.bind(new Skeleton(bones, inverses), new Matrix4());
  }

  // Each joint carries its frame to the world; the figure's first points are its joints.
  place(points, time) {
    turns(this.figure, time, this.turns);
    this.skeleton.bones.forEach((bone, j) => {
      PLACE.fromArray(points, 3 * j);
      bone.matrix.compose(PLACE, TURN.fromArray(this.turns, 4 * j).normalize(), ONE);
      bone.matrixWorldNeedsUpdate = true;
    });
  }
}
