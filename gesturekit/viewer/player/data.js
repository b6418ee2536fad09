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

// Points are stored as whole steps from the root, one channel after the other, each value as its
// difference from the frame before, all low bytes first and then all high bytes.
async function points(figure) {
  const { n_frames: frames, n_points: count, step } = figure;
  const channels = count * 3;
  const packed = await inflate(bytes(figure.points));
  const high = frames * channels;
  const steps = new Int16Array(frames * channels);
  for (let c = 0, at = 0; c < channels; c++) {
    let value = 0;
    for (let t = 0; t < frames; t++, at++) {
      value = (value + packed[at] + (packed[high + at] << 8)) & 0xffff;
      steps[t * channels + c] = value; // kept modulo 2^16, so the sign comes back here
    }
  }
  const root = new Float32Array(bytes(figure.root).buffer);
  return { steps, root, step, channels };
}

export async function read(element) {
  const page = JSON.parse(element.textContent);
  for (const figure of page.figures) {
    Object.assign(figure, await points(figure));
    figure.speed.values = bytes(figure.speed.values);
  }
  if (page.speech) page.speech.peaks = bytes(page.speech.peaks);
  if (page.audio) page.audio.data = bytes(page.audio.data);
  return page;
}

// Fill `out` (3 numbers a point) with where the figure's points are at `time` seconds, halfway
// between frames too, so that motion at 15 frames a second looks smooth on any screen.
export function pose(figure, time, out) {
  const { steps, root, step, channels } = figure;
  const at = Math.min(Math.max(time * figure.fps, 0), figure.n_frames - 1);
  const before = Math.floor(at);
  const after = Math.min(before + 1, figure.n_frames - 1);
  const w = at - before;
  for (let axis = 0; axis < 3; axis++) {
    const r = root[before * 3 + axis] * (1 - w) + root[after * 3 + axis] * w;
    for (let c = axis; c < channels; c += 3) {
      const s = steps[before * channels + c] * (1 - w) + steps[after * channels + c] * w;
      out[c] = r + s * step;
    }
  }
  return out;
}

// The root's place on the ground, averaged over a second, for the camera to follow calmly.
export function calmRoot(figure) {
  const half = Math.max(1, Math.round(figure.fps / 2));
  const { n_frames: frames, root } = figure;
  const sum = new Float64Array((frames + 1) * 3);
  for (let i = 0; i < frames * 3; i++) sum[i + 3] = sum[i] + root[i];
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
