// The page that gesturekit/viewer/html.py writes: reads its data, ties the controls together.
// A page opened with #t=3.5 starts at 3.5 seconds. With data-bare on its root element it shows
// nothing but the figure, and whoever embeds it plays it by window.player.

import { Body } from "./body.js";
import { Clock } from "./clock.js";
import { calmMiddle, pose, read } from "./data.js";
import { live } from "./live.js";
import { Stage } from "./stage.js";
import { Strip } from "./strip.js";

const PLAY = "M8 5v14l11-7z";
const PAUSE = "M7 5h4v14H7zm6 0h4v14h-4z";

const $ = (id) => document.getElementById(id);

function fail(message) {
  $("failure").textContent = message;
  $("failure").hidden = false;
  document.documentElement.dataset.state = "failed";
}

function clockText(seconds) {
  const whole = Math.floor(seconds / 60);
  return `${whole}:${(seconds - 60 * whole).toFixed(1).padStart(4, "0")}`;
}

function showFacts(page) {
  for (const figure of page.figures) {
    const line = document.createElement("span");
    line.textContent = `${figure.n_frames} frames at ${+figure.fps.toFixed(3)} fps, ${figure.file_joints} joints`;
    if (page.figures.length > 1) {
      const label = document.createElement("b");
      label.textContent = `${figure.label} `;
      label.style.color = figure.ink;
      line.prepend(label);
    }
    $("facts").append(line);
  }
}

// One figure is shown where it is. Several stand side by side on one floor, in the order given,
// or in the same place, all facing the same way.
function arrange(bodies, page, overlaid) {
  page.spread = 0;
  page.front = page.figures[0].front;
  page.floor = page.figures[0].floor;
  if (bodies.length === 1) return;
  const gap = overlaid ? 0 : 0.8 * page.height;
  page.spread = (gap * (bodies.length - 1)) / 2;
  page.front = page.floor = 0;
  bodies.forEach((body, i) => {
    const { front, floor } = body.figure;
    const [x, , z] = body.middle(0, [0, 0, 0]);
    body.rotation.y = -front;
    const [cos, sin] = [Math.cos(front), Math.sin(front)];
    body.position.set(i * gap - page.spread - (x * cos - z * sin), -floor, -(x * sin + z * cos));
    body.updateMatrix();
    if (i) body.setTransparent(overlaid);
  });
}

// The middle of all figures on the ground, at `time` seconds.
function middleOf(bodies, time, out) {
  out.fill(0);
  for (const body of bodies) {
    const [x, , z] = body.middle(time, [0, 0, 0]);
    const [cos, sin] = [Math.cos(body.rotation.y), Math.sin(body.rotation.y)];
    out[0] += (body.position.x + x * cos + z * sin) / bodies.length;
    out[2] += (body.position.z - x * sin + z * cos) / bodies.length;
  }
  return out;
}

async function main() {
  const page = await read($("motion"));
  const bodies = page.figures.map((figure, i) => new Body(figure, i, page.height));
  for (const body of bodies) body.middle = calmMiddle(body.figure);
  arrange(bodies, page, false);
  const [first] = page.figures;
  const duration = Math.max(...page.figures.map((f) => f.n_frames / f.fps), page.speech?.duration ?? 0);
  showFacts(page);

  let stage;
  try {
    stage = new Stage($("view"), page);
  } catch (error) {
    return fail(`This page draws with WebGL, which this browser does not offer: ${error.message}`);
  }
  stage.scene.add(...bodies);
  if (page.live) return showLive(page, bodies[0], stage);
  const strip = new Strip($("strip"), page, duration);
  const clock = new Clock(duration, page.audio);
  const middle = [0, 0, 0];
  let shown = -1;

  function show(time) {
    if (time === shown) return;
    shown = time;
    for (const body of bodies) body.place(pose(body.figure, time, body.points), time);
    stage.setMiddle(middleOf(bodies, time, middle), $("follow").checked);
    strip.draw(time);
    // Whole pixels: a slider that moves by less is drawn again for nothing.
    const place = Math.round((time / duration) * $("scrub").clientWidth) / $("scrub").clientWidth || 0;
    if (place !== Number($("scrub").value)) $("scrub").value = place;
    const frame = Math.min(Math.floor(time * first.fps + 1e-6), first.n_frames - 1);
    $("time").innerHTML = `${clockText(time)} / ${clockText(duration)}<small>frame ${frame}</small>`;
  }

  function showPlaying() {
    $("play-icon").setAttribute("d", clock.playing ? PAUSE : PLAY);
    $("play").setAttribute("aria-label", clock.playing ? "Pause" : "Play");
  }

  const toggle = () => { clock.playing ? clock.pause() : clock.play(); showPlaying(); };
  const seek = (time) => { clock.seek(time); show(clock.time); };
  const setRate = () => clock.setRate(Number($("speed").value));
  const changeSpeed = (by) => {
    const { options, selectedIndex } = $("speed");
    $("speed").selectedIndex = Math.min(Math.max(selectedIndex + by, 0), options.length - 1);
    setRate();
  };
  const redraw = () => { const time = shown; shown = -1; show(time); };
  const overlay = () => {
    arrange(bodies, page, $("overlay").checked);
    stage.spread = page.spread;
    redraw();
    stage.frontView();
  };
  const showTrails = () => {
    for (const body of bodies) body.trail.visible = $("trail").checked;
    redraw();
  };
  const fillScreen = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  };
  const darkness = window.matchMedia("(prefers-color-scheme: dark)");
  const setTheme = () => { stage.setTheme(darkness.matches); strip.paint(); strip.draw(shown); };
  const flip = (id) => { $(id).click(); };
  const showShortcuts = (shown) => {
    $("shortcuts").hidden = !shown;
    $("help").setAttribute("aria-expanded", String(shown));
  };

  $("play").addEventListener("click", toggle);
  $("reset").addEventListener("click", () => stage.frontView());
  $("help").addEventListener("click", () => showShortcuts($("shortcuts").hidden));
  $("scrub").addEventListener("input", (event) => seek(event.target.value * duration));
  $("speed").addEventListener("change", setRate);
  $("overlay").addEventListener("change", overlay);
  $("trail").addEventListener("change", showTrails);
  $("full").addEventListener("click", fillScreen);
  $("full").hidden = !document.fullscreenEnabled;
  $("overlay").parentElement.hidden = bodies.length === 1;
  $("trail").parentElement.hidden = !page.figures.some((figure) => figure.hands.length);
  darkness.addEventListener("change", setTheme);
  $("loop").addEventListener("change", (event) => { clock.loop = event.target.checked; });

  const stripSeek = (event) => {
    const box = $("strip").getBoundingClientRect();
    seek(((event.clientX - box.left) / box.width) * duration);
  };
  $("strip").addEventListener("pointerdown", (event) => {
    $("strip").setPointerCapture(event.pointerId);
    stripSeek(event);
  });
  $("strip").addEventListener("pointermove", (event) => { if (event.buttons & 1) stripSeek(event); });

  const keys = {
    " ": toggle,
    ArrowLeft: (event) => seek(clock.time - (event.shiftKey ? 1 : 1 / first.fps)),
    ArrowRight: (event) => seek(clock.time + (event.shiftKey ? 1 : 1 / first.fps)),
    ArrowUp: () => changeSpeed(1),
    ArrowDown: () => changeSpeed(-1),
    Home: () => seek(0),
    End: () => seek(duration),
    f: () => flip("follow"),
    l: () => flip("loop"),
    o: () => { if (bodies.length > 1) flip("overlay"); },
    t: () => flip("trail"),
    s: fillScreen,
    r: () => stage.frontView(),
    "?": () => flip("help"),
    Escape: () => showShortcuts(false),
  };
  window.addEventListener("keydown", (event) => {
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || bare || event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    event.preventDefault();
    act(event);
  });

  // A control keeps no focus after a click, so that space goes on meaning play.
  window.addEventListener("pointerup", () => { if (document.activeElement?.tagName !== "SELECT") document.activeElement?.blur(); });
  window.addEventListener("resize", () => { stage.resize(); strip.resize(); strip.draw(shown); });

  seek(Number(new URLSearchParams(location.hash.slice(1)).get("t")) || 0);
  setTheme();
  stage.frontView();
  const bare = "bare" in document.documentElement.dataset;
  if (!page.audio && !location.hash && !bare) { clock.play(); showPlaying(); }
  window.player = clock;

  document.documentElement.dataset.state = "ready";
  document.documentElement.dataset.frames = page.figures.map((f) => f.n_frames).join(",");
  requestAnimationFrame(function draw(now) {
    const wasPlaying = clock.playing;
    clock.tick(now);
    show(clock.time);
    if (clock.playing !== wasPlaying) showPlaying();
    stage.setMoving(clock.playing, now);
    for (const body of bodies) body.shape.setCoarse(stage.coarse);
    stage.draw();
    requestAnimationFrame(draw);
  });
}

// A page that is fed by gesturekit/live/page.py has no end, and so no controls of time.
function showLive(page, body, stage) {
  document.documentElement.dataset.live = "";
  $("facts").replaceChildren();
  const show = live(page, body, stage, $("facts"));
  const darkness = window.matchMedia("(prefers-color-scheme: dark)");
  const setTheme = () => stage.setTheme(darkness.matches);
  darkness.addEventListener("change", setTheme);
  window.addEventListener("resize", () => stage.resize());
  setTheme();
  stage.resize();
  stage.frontView();
  document.documentElement.dataset.state = "ready";
  requestAnimationFrame(function draw(now) {
    show();
    stage.setMoving(true, now);
    body.shape.setCoarse(stage.coarse);
    stage.draw();
    requestAnimationFrame(draw);
  });
}

window.addEventListener("error", (event) => fail(`This page could not be shown: ${event.message}`));
main().catch((error) => fail(`This page could not be shown: ${error.message}`));
