// The page's own data: what gesturekit/viewer/html.py wrote, and how it is read back.

function bytes(base64) {
  const text = atob(base64);
  const out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out;
}

async function inflate(compressed) {
  const stream = new Blob([compressed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Whole numbers of 16 bits are stored one channel after the other, each value as its difference
// from the frame before, all low bytes first and then all high bytes.
async function unpack(base64, frames, channels) {
  const packed = await inflate(bytes(base64));
  const high = frames * channels;
  const values = new Int16Array(frames * channels);
  for (let c = 0, at = 0; c < channels; c++) {
    let value = 0;
    for (let t = 0; t < frames; t++, at++) {
      value = (value + packed[at] + (packed[high + at] << 8)) & 0xffff;
      values[t * channels + c] = value; // kept modulo 2^16, so the sign comes back here
    }
  }
  return values;
}

// Points are stored as whole steps from the root.
async function points(figure) {
  const { n_frames: frames, n_points: count, step } = figure;
  const channels = count * 3;
  const steps = await unpack(figure.points, frames, channels);
  const root = new Float32Array(bytes(figure.root).buffer);
  return { steps, root, step, channels };
}

// How a face channel of value 1 moves each of `count` vertices (3 numbers a vertex).
async function morph({ n_vertices, step, ...packed }, count) {
  const vertices = new Uint16Array((await unpack(packed.vertices, n_vertices, 1)).buffer);
  const steps = await unpack(packed.offsets, n_vertices, 3);
  const offsets = new Float32Array(3 * count);
  vertices.forEach((vertex, k) => {
    for (let axis = 0; axis < 3; axis++) offsets[3 * vertex + axis] = step * steps[3 * k + axis];
  });
  return offsets;
}

// A mesh at rest, in steps from its middle.
async function level({ n_vertices, n_faces, middle, step, morphs = [], ...packed }) {
  const steps = await unpack(packed.vertices, n_vertices, 3);
  const small = async (text) => inflate(bytes(text));
  return {
    vertices: Float32Array.from(steps, (value, i) => middle[i % 3] + step * value),
    faces: new Uint16Array((await unpack(packed.faces, n_faces, 3)).buffer),
    joints: await small(packed.joints),
    weights: await small(packed.weights),
    regions: await small(packed.regions),
    morphs: await Promise.all(morphs.map((each) => morph(each, n_vertices))),
  };
}

// Meshes that all figures share: those of a body model, or all levels of detail of the human body.
async function meshes(skin) {
  if (skin.levels) return Promise.all(skin.levels.map(level));
  const faces = new Uint32Array(bytes(skin.faces).buffer);
  return [{ faces, joints: bytes(skin.joints), weights: bytes(skin.weights) }];
}

// A figure's skin at rest, finest level first. A frame has four numbers of `turns` for each joint, its
// quaternion, and a weight in `face` for each morph of the finest level.
async function skin({ n_frames: frames, n_joints: count, skin }, shared) {
  const { scale, palette } = skin;
  const scaled = (places) => places.map((x) => scale * x);
  const sized = (mesh) => (
    skin.vertices ? { vertices: new Float32Array(bytes(skin.vertices).buffer) } : {
      vertices: scaled(mesh.vertices), morphs: skin.face ? mesh.morphs.map(scaled) : [],
    }
  );
  return {
    palette,
    levels: shared.map((mesh) => ({ ...mesh, ...sized(mesh) })),
    rest: new Float32Array(bytes(skin.joints).buffer),
    turns: await unpack(skin.turns, frames, 4 * count),
    face: skin.face && Float32Array.from(await inflate(bytes(skin.face)), (value) => value / 255),
  };
}

export async function read(element) {
  const page = JSON.parse(element.textContent);
  const shared = page.skin && (await meshes(page.skin));
  for (const figure of page.figures) {
    if (figure.skin) figure.skin = await skin(figure, shared);
    Object.assign(figure, await points(figure));
    figure.speed.values = bytes(figure.speed.values);
    figure.contacts &&= bytes(figure.contacts);
  }
  if (page.speech) {
    page.speech.peaks = bytes(page.speech.peaks);
    page.speech.spectrum.values = bytes(page.speech.spectrum.values);
  }
  if (page.audio) page.audio.data = bytes(page.audio.data);
  return page;
}

// The frames around `time` seconds, and how far it is from the one to the other.
function around(figure, time) {
  const at = Math.min(Math.max(time * figure.fps, 0), figure.n_frames - 1);
  const before = Math.floor(at);
  return [before, Math.min(before + 1, figure.n_frames - 1), at - before];
}

// Fill `out` with the numbers of a frame of `values` at `time` seconds; quaternions among them are
// not quite of length 1.
export function mixed(figure, values, time, out) {
  const [before, after, w] = around(figure, time);
  const count = out.length;
  for (let c = 0; c < count; c++) {
    out[c] = values[before * count + c] * (1 - w) + values[after * count + c] * w;
  }
  return out;
}

// Fill `out` (3 numbers a point) with where the figure's points are at `time` seconds, halfway
// between frames too, so that motion at 15 frames a second looks smooth on any screen.
export function pose(figure, time, out) {
  const { steps, root, step, channels } = figure;
  const [before, after, w] = around(figure, time);
  for (let axis = 0; axis < 3; axis++) {
    const r = root[before * 3 + axis] * (1 - w) + root[after * 3 + axis] * w;
    for (let c = axis; c < channels; c += 3) {
      const s = steps[before * channels + c] * (1 - w) + steps[after * channels + c] * w;
      out[c] = r + s * step;
    }
  }
  return out;
}

// Fill `out` with where one of the figure's points is at `time` seconds.
export function point(figure, index, time, out) {
  const { steps, root, step, channels } = figure;
  const [before, after, w] = around(figure, time);
  for (let axis = 0; axis < 3; axis++) {
    const c = 3 * index + axis;
    const r = root[before * 3 + axis] * (1 - w) + root[after * 3 + axis] * w;
    out[axis] = r + (steps[before * channels + c] * (1 - w) + steps[after * channels + c] * w) * step;
  }
  return out;
}

// The figure's middle, averaged over a second, for the camera to follow calmly. It is the middle of
// all points, as some files move a body under a root that stays where it is.
export function calmMiddle(figure) {
  const half = Math.max(1, Math.round(figure.fps / 2));
  const { n_frames: frames, root, steps, step, channels } = figure;
  const sum = new Float64Array((frames + 1) * 3);
  const scale = (3 * step) / channels;
  for (let t = 0; t < frames; t++) {
    for (let axis = 0; axis < 3; axis++) {
      let total = 0;
      for (let c = axis; c < channels; c += 3) total += steps[t * channels + c];
      sum[(t + 1) * 3 + axis] = sum[t * 3 + axis] + root[t * 3 + axis] + total * scale;
    }
  }
  return (time, out) => {
    const t = Math.min(Math.max(Math.round(time * figure.fps), 0), frames - 1);
    const from = Math.max(0, t - half);
    const to = Math.min(frames, t + half + 1);
    for (let axis = 0; axis < 3; axis++) {
      out[axis] = (sum[to * 3 + axis] - sum[from * 3 + axis]) / (to - from);
    }
    return out;
  };
}
