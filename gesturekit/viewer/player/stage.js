// The room the figure stands in: ground, light, camera.

import {
  BufferGeometry, CircleGeometry, Color, DirectionalLight, Float32BufferAttribute, HemisphereLight,
  LineSegments, Mesh, NeutralToneMapping, PCFShadowMap, PerspectiveCamera, Scene, ShaderMaterial,
  ShadowMaterial, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const PIECE = 4; // squares of the floor between two points of a line
const FIELD = Math.tan((15 * Math.PI) / 180); // half the window's height at distance 1
const MARGIN = 16; // pixels of the canvas below the controls, whose corners are round

// Most pixels drawn for one of the page while the figure moves. The first is for graphics cards; the
// others leave out shadows and draw coarse bodies, and are taken one after the other while frames
// come too late.
const RATIOS = [2, 1, 0.75, 0.5];
const SOFTWARE = 2; // where a processor that draws begins
const WANTED = 24; // frames a second
const PATIENCE = 1500; // milliseconds of fewer frames before less is drawn
const BREAK = 500; // milliseconds without a frame: the page was hidden

// A floor with a line every half metre that fades into the background; ten times as near or as far
// for every factor of ten that the figure is smaller or taller than a person. Lines and not a
// surface: a processor that draws would compute each pixel of the floor.
function grid(size, height) {
  const step = 0.5 * 10 ** Math.round(Math.log10(height / 1.7));
  const count = Math.ceil(size / step / 2) * 2; // even, so that every second line is a whole metre's
  const places = [];
  const strengths = [];
  for (let line = -count; line <= count; line++) {
    const reach = Math.floor(Math.sqrt(Math.max(0, count * count - line * line)));
    // In pieces, as the ends of each fade.
    for (let from = -reach; from < reach; from += PIECE) {
      const to = Math.min(from + PIECE, reach);
      places.push(line * step, 0, from * step, line * step, 0, to * step);
      places.push(from * step, 0, line * step, to * step, 0, line * step);
      for (let end = 0; end < 4; end++) strengths.push(line % 2 ? 0.2 : 0.42);
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new Float32BufferAttribute(places, 3));
  geometry.setAttribute("strength", new Float32BufferAttribute(strengths, 1));
  const material = new ShaderMaterial({
    transparent: true,
    depthWrite: false,
    uniforms: { size: { value: size }, middle: { value: new Vector3() }, ink: { value: new Color("#8d99a6") } },
    vertexShader: `
      uniform float size; uniform vec3 middle;
      attribute float strength;
      varying float alpha;
      void main() {
        vec4 place = modelMatrix * vec4(position, 1.0);
        alpha = strength * (1.0 - smoothstep(0.25 * size, size, distance(place.xz, middle.xz)));
        gl_Position = projectionMatrix * viewMatrix * place;
      }`,
    fragmentShader: `
      uniform vec3 ink;
      varying float alpha;
      void main() { gl_FragColor = vec4(ink, alpha); }`,
  });
  const lines = new LineSegments(geometry, material);
  lines.frustumCulled = false;
  // Lines stay where they are in the world, whatever the middle.
  lines.centre = (x, y, z) => {
    material.uniforms.middle.value.set(x, y, z);
    const metre = 2 * step;
    lines.position.set(Math.round(x / metre) * metre, y, Math.round(z / metre) * metre);
  };
  return lines;
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
  constructor(canvas, { height, below, floor, front, spread }) {
    this.canvas = canvas;
    this.height = height;
    this.below = below; // what of the figure is below the view
    this.floor = floor;
    this.front = front;
    this.spread = spread;
    this.dirty = true;
    this.middle = new Vector3();
    this.moving = false;
    const software = isSoftware();
    this.step = software ? SOFTWARE : 0;
    document.documentElement.toggleAttribute("data-software", software);
    this.renderer = new WebGLRenderer({ canvas, antialias: !software, alpha: true });
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
    this.controls.minDistance = 0.25 * height;
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
    this.scene.add(this.shade, this.grid);
  }

  // Ground, light and shadow stay around the figure wherever it walks.
  setMiddle([x, , z], follow) {
    const { middle, height, floor, front } = this;
    const dx = x - middle.x;
    const dz = z - middle.z;
    middle.set(x, floor, z);
    this.grid.centre(x, floor, z);
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

  // Put the camera before the figure's face, far enough to see all that is to be seen of it above
  // the controls.
  frontView() {
    const { camera, controls, middle, height, below, floor, front, spread } = this;
    const half = Math.tan((camera.fov * Math.PI) / 360);
    const tallest = this.canvas.clientHeight;
    const clear = Math.max(0.3, 1 - (this.titled + 40) / tallest);
    const tall = (1.14 * (height - below)) / (2 * half * clear);
    const wide = (Math.min((below ? 0.9 : 1.25) * height, 1.64 * (height - below)) + 2 * spread) / (2 * half * camera.aspect);
    const distance = Math.max(tall, wide);
    // Aim at what lies in the middle of the canvas when the figure's middle is midway between the
    // title and the controls, so that the floor is not hidden.
    const lower = (distance * half * (MARGIN - this.titled)) / tallest;
    controls.target.set(middle.x, floor + 0.5 * (below + height) - lower, middle.z);
    const turn = front + 0.32;
    camera.position.set(
      middle.x + distance * Math.sin(turn), controls.target.y + 0.16 * distance, middle.z + distance * Math.cos(turn),
    );
    controls.update();
    this.dirty = true;
  }

  // The canvas ends behind the upper edge of the controls: what they cover need not be drawn.
  resize() {
    this.titled = document.querySelector("header").offsetHeight;
    this.canvas.parentElement.style.bottom = `${document.querySelector("footer").offsetHeight}px`;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    // A still picture has time for fine edges, a moving one on a slow machine has not.
    const still = this.step >= SOFTWARE ? 2 : ratio;
    this.renderer.setPixelRatio(this.coarse ? Math.min(ratio, RATIOS[this.step]) : still);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.fov = (360 / Math.PI) * Math.atan((FIELD * height) / window.innerHeight);
    this.camera.updateProjectionMatrix();
    this.dirty = true;
  }

  // Whether a slow machine shows a figure that moves: without shadows, and with fewer pixels.
  get coarse() {
    return this.moving && this.step > 0;
  }

  // Called once a drawn frame with the time in milliseconds.
  setMoving(moving, now) {
    if (moving !== this.moving) {
      this.moving = moving;
      this.since = null;
      this.applyDetail();
    } else if (moving) this.keepPace(now);
  }

  applyDetail() {
    this.sun.castShadow = this.shade.visible = !this.coarse;
    if (this.step > 0) this.resize();
  }

  // Draw less if frames have come too late for a while.
  keepPace(now) {
    if (this.since === null || now - this.last > BREAK) {
      this.since = now;
      this.frames = 0;
    }
    this.last = now;
    this.frames += 1;
    if (now - this.since < PATIENCE) return;
    const isLate = (this.frames - 1) * 1000 < WANTED * (now - this.since);
    this.since = null;
    if (!isLate || this.step === RATIOS.length - 1) return;
    this.step += 1;
    this.applyDetail();
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
