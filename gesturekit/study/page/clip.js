// One side of a comparison: a video, or the 3D player of gesturekit/viewer in a frame.
// Both have: element, load() -> seconds, play(seconds, onTime) -> promise of its end, stop().

const shell = () => JSON.parse(document.getElementById("shell").textContent);
const motions = new Map();
const SHARED = "body"; // the script of the mesh that all clips wear, if they wear one

// A page opened from a disk may not fetch files, but may run scripts: see `_write_script` in build.py.
window.gesturekitClip = (id, motion) => motions.set(id, motion);

function loadScript(file) {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = file;
    script.onload = () => { script.remove(); resolve(); };
    script.onerror = () => reject(new Error(`${file} could not be loaded`));
    document.head.append(script);
  });
}

function until(check, failed) {
  return new Promise((resolve, reject) => {
    (function look() {
      if (check()) resolve();
      else if (failed()) reject(new Error(failed()));
      else setTimeout(look, 30);
    })();
  });
}

class MotionClip {
  constructor({ motion, seconds }) {
    this.id = motion;
    this.seconds = seconds;
    this.element = document.createElement("iframe");
    this.element.title = "";
    this.element.tabIndex = -1;
  }

  async load() {
    if (!motions.has(this.id)) await loadScript(`clips/${this.id}.js`);
    const motion = motions.get(this.id);
    if (motion.skin === SHARED) {
      if (!motions.has(SHARED)) await loadScript(`clips/${SHARED}.js`);
      motion.skin = motions.get(SHARED);
    }
    const page = shell()
      .replace("<html ", "<html data-bare ")
      .replaceAll("{{title}}", "")
      .replace("{{motion}}", () => JSON.stringify(motion).replaceAll("<", "\\u003c"));
    motions.delete(this.id);
    this.element.srcdoc = page;
    const root = () => this.element.contentDocument?.documentElement?.dataset ?? {};
    await until(
      () => root().state === "ready",
      () => root().state === "failed" && this.element.contentDocument.getElementById("failure").textContent,
    );
    return this.seconds;
  }

  play(seconds, onTime) {
    const { player } = this.element.contentWindow;
    player.seek(0);
    player.play();
    return new Promise((resolve) => {
      const look = () => {
        this.frame = requestAnimationFrame(look);
        const time = Math.min(player.time, seconds);
        onTime(time);
        if (time < seconds && player.playing) return;
        this.stop();
        onTime(seconds);
        resolve();
      };
      look();
    });
  }

  stop() {
    cancelAnimationFrame(this.frame);
    this.element.contentWindow?.player?.pause();
  }
}

class VideoClip {
  constructor({ video, sound, silent }) {
    this.element = document.createElement("video");
    this.element.src = `clips/${video}`;
    this.element.preload = "auto";
    this.element.playsInline = true;
    this.element.disablePictureInPicture = true;
    this.element.muted = silent || Boolean(sound);
    // A mismatched clip: this video with the sound of another one.
    this.sound = null;
    if (sound && !silent) {
      this.sound = document.createElement("audio");
      this.sound.src = `clips/${sound}`;
      this.sound.preload = "auto";
    }
  }

  get media() {
    return this.sound ? [this.element, this.sound] : [this.element];
  }

  async load() {
    for (const medium of this.media) {
      await until(() => medium.readyState >= 2, () => medium.error && "A video could not be played by this browser.");
    }
    return Math.min(...this.media.map((medium) => medium.duration));
  }

  play(seconds, onTime) {
    return new Promise((resolve, reject) => {
      for (const medium of this.media) {
        medium.currentTime = 0;
        medium.play().catch(reject);
      }
      const look = () => {
        this.frame = requestAnimationFrame(look);
        onTime(Math.min(this.element.currentTime, seconds));
        if (this.element.currentTime < seconds - 0.02 && !this.element.ended) return;
        this.stop();
        onTime(seconds);
        resolve();
      };
      look();
    });
  }

  stop() {
    cancelAnimationFrame(this.frame);
    for (const medium of this.media) medium.pause();
  }
}

export const makeClip = (side) => (side.video ? new VideoClip(side) : new MotionClip(side));
