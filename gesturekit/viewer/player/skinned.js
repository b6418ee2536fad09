// Meshes of several levels of detail that one set of bones moves, each one draw call.

import { Bone, Color, Group, Matrix4, Skeleton, SkinnedMesh } from "three";

export class Skinned extends Group {
  // `shapes` are geometries, the finest first; `inverses` take each bone's rest pose to its frame.
  // With `isColoured`, the vertices have their own colours.
  bind(shapes, material, inverses, isColoured) {
    this.bones = inverses.map(() => {
      const bone = new Bone();
      bone.matrixAutoUpdate = false;
      return bone;
    });
    const skeleton = new Skeleton(this.bones, inverses);
    if (isColoured) Object.assign(material, { vertexColors: true, color: new Color("white") });
    this.levels = shapes.map((shape) => {
      const mesh = new SkinnedMesh(shape, material);
      mesh.castShadow = mesh.receiveShadow = true;
      mesh.frustumCulled = false;
      mesh.bind(skeleton, new Matrix4());
      return mesh;
    });
    this.add(...this.levels, ...this.bones);
    this.setCoarse(false);
  }

  // Draw few vertices, or all; a body with a face keeps its finest level, which alone has one.
  setCoarse(coarse) {
    const hasFace = this.levels[0].morphTargetInfluences?.length;
    const shown = coarse && !hasFace ? this.levels.length - 1 : 0;
    this.levels.forEach((mesh, k) => { mesh.visible = k === shown; });
  }
}
