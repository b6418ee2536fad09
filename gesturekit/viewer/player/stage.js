// The room the figure stands in: ground, light, camera.

import {
  CircleGeometry, Color, DirectionalLight, HemisphereLight, Mesh, NeutralToneMapping,
  PCFShadowMap, PerspectiveCamera, Scene, ShaderMaterial, ShadowMaterial, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

// A floor with a line every half metre that fades into the background; ten times as near or as far
// for every factor of ten that the figure is smaller or taller than a person.
function grid(size, height) {
  const metre = 10 ** Math.round(Math.log10(height / 1.7));
  const material = new ShaderMaterial({
    transparent: true,
    depthWrite: false,
    uniforms: { size: { value: size }, metre: { value: metre }, middle: { value: new Vector3() }, ink: { value: new Color("#8d99a6") } },
    vertexShader: `
      varying vec3 place;
      void main() {
        place = (modelMatrix * vec4(position, 1.0)).xyz;
        gl_Position = projectionMatrix * viewMatrix * vec4(place, 1.0);
      }`,
    fragmentShader: `
      uniform float size; uniform float metre; uniform vec3 middle; uniform vec3 ink;
      varying vec3 place;
      float lines(float every) {
        vec2 at = place.xz / every;
        vec2 near = abs(fract(at - 0.5) - 0.5) / fwidth(at);
        return 1.0 - min(min(near.x, near.y), 1.0);
      }
      void main() {
        float fade = 1.0 - smoothstep(0.25 * size, size, distance(place.xz, middle.xz));
        float strength = max(0.16 * lines(0.5 * metre), 0.34 * lines(metre));
        gl_FragColor = vec4(ink, strength * fade);
      }`,
  });
  const mesh = new Mesh(new CircleGeometry(size, 64), material);
  mesh.rotation.x = -Math.PI / 2;
  return mesh;
}

// Whether the processor draws: then half of what a graphics card does at once would stutter.
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const facts = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = facts ? gl.getParameter(facts.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

export class Stage {
  constructor(canvas, { height, floor, front, spread }) {
    this.canvas = canvas;
    this.height = height;
    this.floor = floor;
    this.front = front;
    this.spread = spread;
    this.dirty = true;
    this.middle = new Vector3();
    this.moving = false;
    this.slow = isSoftware();
    this.renderer = new WebGLRenderer({ canvas, antialias: !this.slow, alpha: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.toneMapping = NeutralToneMapping;
    this.renderer.toneMappingExposure = 0.95;
    this.scene = new Scene();
    this.addLight();
    this.addGround();
    this.camera = new PerspectiveCamera(30, 1, 0.05 * height, 60 * height);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.maxPolarAngle = 0.55 * Math.PI;
    this.controls.minDistance = 0.4 * height;
    this.controls.maxDistance = 20 * height;
    this.controls.addEventListener("change", () => { this.dirty = true; });
    this.resize();
  }

  addLight() {
    const { height, spread } = this;
    this.sun = new DirectionalLight("#fff4e6", 2.0);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    const reach = 1.1 * height + spread;
    Object.assign(this.sun.shadow.camera, {
      left: -reach, right: reach, top: reach, bottom: -reach, near: 0.1 * height, far: 6 * height,
    });
    this.sun.shadow.radius = 6;
    this.sun.shadow.bias = -0.0004;
    this.sun.shadow.normalBias = 0.012 * height;
    this.scene.add(this.sun, this.sun.target, new HemisphereLight("#ffffff", "#cdd0d6", 2.3));
  }

  addGround() {
    const size = 5 * this.height + this.spread;
    this.grid = grid(size, this.height);
    this.shade = new Mesh(new CircleGeometry(size, 64), new ShadowMaterial({ opacity: 0.26, color: "#20303f" }));
    this.shade.rotation.x = -Math.PI / 2;
    this.shade.receiveShadow = true;
    this.shade.position.y = this.floor - 0.001 * this.height;
    this.grid.position.y = this.floor;
    this.scene.add(this.shade, this.grid);
  }

  // Ground, light and shadow stay around the figure wherever it walks.
  setMiddle([x, , z], follow) {
    const { middle, height, floor, front } = this;
    const dx = x - middle.x;
    const dz = z - middle.z;
    middle.set(x, floor, z);
    this.grid.position.set(x, floor, z);
    this.grid.material.uniforms.middle.value.copy(middle);
    this.shade.position.set(x, floor - 0.001 * height, z);
    this.sun.target.position.copy(middle);
    const turn = front + 0.6;
    this.sun.position.set(x + 1.6 * height * Math.sin(turn), floor + 2.6 * height, z + 1.6 * height * Math.cos(turn));
    if (follow) {
      this.camera.position.x += dx;
      this.camera.position.z += dz;
      this.controls.target.x += dx;
      this.controls.target.z += dz;
    }
    this.dirty = true;
  }

  // Put the camera before the figure's face, far enough to see all of it above the controls.
  frontView() {
    const { camera, controls, middle, height, floor, front, spread } = this;
    const half = Math.tan((camera.fov * Math.PI) / 360);
    const tallest = this.canvas.clientHeight;
    const clear = Math.max(0.3, 1 - (this.covered + this.titled + 40) / tallest);
    const tall = (1.14 * height) / (2 * half * clear);
    const wide = (1.25 * height + 2 * spread) / (2 * half * camera.aspect);
    const distance = Math.max(tall, wide);
    // Aim at what lies in the middle of the canvas when the figure's middle is midway between the
    // title and the controls, so that the floor is not hidden.
    const lower = (distance * half * (this.covered + 16 - this.titled)) / tallest;
    controls.target.set(middle.x, floor + 0.5 * height - lower, middle.z);
    const turn = front + 0.32;
    camera.position.set(
      middle.x + distance * Math.sin(turn), controls.target.y + 0.16 * distance, middle.z + distance * Math.cos(turn),
    );
    controls.update();
    this.dirty = true;
  }

  resize() {
    this.covered = document.querySelector("footer").offsetHeight;
    this.titled = document.querySelector("header").offsetHeight;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    // A still picture has time for fine edges, a moving one on a slow machine has not.
    this.renderer.setPixelRatio(this.slow ? (this.moving ? 0.75 : 2) : ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
    this.dirty = true;
  }

  // While the figure moves, a slow machine draws no shadows and fewer pixels.
  setMoving(moving) {
    if (moving === this.moving) return;
    this.moving = moving;
    if (!this.slow) return;
    this.sun.castShadow = this.shade.visible = !moving;
    this.resize();
  }

  setTheme(dark) {
    this.grid.material.uniforms.ink.value.set(dark ? "#93a1af" : "#8d99a6");
    this.shade.material.color.set(dark ? "#000000" : "#20303f");
    this.shade.material.opacity = dark ? 0.5 : 0.26;
    this.dirty = true;
  }

  // Draw if anything changed since the last time.
  draw() {
    this.controls.update();
    if (!this.dirty) return;
    this.renderer.render(this.scene, this.camera);
    this.dirty = false;
  }
}
