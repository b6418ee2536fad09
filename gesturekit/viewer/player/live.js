// A page whose motion arrives while it is made: see gesturekit/live/page.py for the messages.

import { Quaternion, Vector3 } from "three";
import { pose } from "./data.js";

const KEPT = 2; // seconds of motion in memory
const WINDOW = 3; // seconds over which the latest frame sets the delay
const LONGER = 0.5; // how fast the delay grows, in seconds a second: frames come too late
const SHORTER = 0.05; // and how fast it shrinks, which no one sees
const JUMP = 1; // a longer way, in seconds, is not gone slowly: the sender was stopped
const RETRY = 2000; // milliseconds
const BEFORE = new Quaternion();
const IN_SYNC = 0.15; // seconds by which sound may be off its motion
const CALM = 0.02; // share of the way that the camera follows in a drawn frame

// Time at which a frame is shown: a delay after its own, as long as the frame that came latest needs.
// The delay is measured on the page's own clock, so that it follows the sender's however both drift.
export class Playout {
  constructor() {
    this.recent = [];
    this.delay = null;
  }

  // A frame of the sender's `time` came at the page's `now`, both in seconds.
  arrived(time, now) {
    const late = now - time;
    if (this.delay === null || Math.abs(late - this.delay) > JUMP) {
      this.recent = [];
      this.delay = late;
      this.last = now;
    }
    this.recent.push([now, late]);
    while (this.recent[0][0] < now - WINDOW) this.recent.shift();
  }

  // The sender's time to show at the page's `now`.
  at(now) {
    const lates = this.recent.map(([, late]) => late);
    const passed = now - this.last;
    const change = Math.max(...lates) - this.delay;
    this.delay += Math.min(Math.max(change, -SHORTER * passed), LONGER * passed);
    this.last = now;
    this.fastest = Math.min(...lates);
    return now - this.delay;
  }
}

// Make a figure hold the last frames that came, in place of the motion of the page.
function emptied(figure, { parents }) {
  const count = Math.ceil(KEPT * figure.fps);
  figure.channels = 3 * parents.length;
  Object.assign(figure, { n_frames: 0, step: 1, steps: new Float32Array(count * figure.channels) });
  figure.root = new Float32Array(3 * count);
  if (figure.skin) figure.skin.turns = new Float32Array(count * 4 * figure.n_joints);
  return count;
}

// Append a frame: the root's position, and the local quaternions of the joints.
function append(figure, { parents, offsets }, count, numbers) {
  const { steps, channels, n_joints: joints, skin } = figure;
  const rows = [[steps, channels]];
  if (skin) rows.push([skin.turns, 4 * joints]);
  if (figure.n_frames === count) for (const [values, width] of rows) values.copyWithin(0, width);
  else figure.n_frames += 1;
  const frame = figure.n_frames - 1;
  const turns = [];
  const places = [];
  parents.forEach((above, j) => {
    const turn = new Quaternion();
    if (j < joints) turn.fromArray(numbers, 3 + 4 * j);
    const place = new Vector3().fromArray(above < 0 ? numbers : offsets[j]);
    if (above >= 0) {
      turn.premultiply(turns[above]);
      place.applyQuaternion(turns[above]).add(places[above]);
    }
    turns.push(turn);
    places.push(place);
    place.toArray(steps, frame * channels + 3 * j);
  });
  for (let j = 0, at = 4 * joints * frame; skin && j < joints; j++, at += 4) {
    // q and -q are the same rotation; the nearer one can be interpolated.
    const isFar = frame && BEFORE.fromArray(skin.turns, at - 4 * joints).dot(turns[j]) < 0;
    skin.turns.set(turns[j].toArray().map((value) => (isFar ? -value : value)), at);
  }
}

// Show the frames that come, on a page that has been read and set up.
export function live(page, body, stage, facts) {
  const { figure } = body;
  const playout = new Playout();
  const count = emptied(figure, page.live);
  body.points = new Float32Array(figure.channels);
  const middle = [0, 0, 0];
  let newest = null;
  let lag = NaN;
  const sound = page.audio && new Audio(URL.createObjectURL(new Blob([page.audio.data], page.audio)));
  let isSilent = !sound; // browsers may want a click before they play sound
  window.addEventListener("pointerdown", () => { isSilent = !sound; });
  body.visible = false;

  function connect(isFirst) {
    const address = new URL("stream", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    // Another run may have another rig.
    if (!isFirst) socket.onopen = () => location.reload();
    socket.onclose = () => {
      newest = null;
      sound?.pause();
      facts.textContent = "The stream has ended; waiting for another one.";
      setTimeout(connect, RETRY);
    };
    socket.onmessage = ({ data }) => {
      const header = new DataView(data);
      const time = header.getFloat64(0, true);
      const now = performance.now() / 1000;
      if (newest !== null && Math.abs(time - newest - 1 / figure.fps) > 0.5 / figure.fps) figure.n_frames = 0;
      newest = time;
      playout.arrived(time, now);
      append(figure, page.live, count, new Float32Array(data, 16));
      lag = header.getFloat64(8, true);
      document.documentElement.dataset.frames = Number(document.documentElement.dataset.frames ?? 0) + 1;
    };
  }

  // Called once a drawn frame.
  function show() {
    if (newest === null) return;
    const first = newest - (figure.n_frames - 1) / figure.fps;
    const now = performance.now() / 1000;
    const shown = Math.min(playout.at(now), newest);
    const time = shown - first;
    body.place(pose(figure, time, body.points), time);
    if (!isSilent && !sound.ended) {
      if (sound.currentTime < shown - IN_SYNC) sound.currentTime = shown;
      if (sound.currentTime > shown + IN_SYNC) sound.pause(); // frames are late
      else if (sound.paused) sound.play().catch(() => { isSilent = true; });
    }
    const isStart = !body.visible;
    body.visible = true;
    for (const axis of [0, 2]) middle[axis] += (body.points[axis] - middle[axis]) * (isStart ? 1 : CALM);
    stage.setMiddle(middle, true);
    if (isStart) stage.frontView();
    // What the fastest frame needed on its way is not known; it is next to nothing on one machine.
    const after = lag + now - shown - playout.fastest;
    facts.textContent = `${shown.toFixed(1)} s${Number.isNaN(after) ? "" : `, shown ${after.toFixed(2)} s after the sound`}${sound && isSilent ? "; click for the sound" : ""}`;
  }

  connect(true);
  window.live = { Playout, figure, sound };
  return show;
}
