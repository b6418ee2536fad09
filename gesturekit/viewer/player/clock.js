// One time for everything. While there is sound, the sound's own clock is the time.

export class Clock {
  constructor(duration, audio) {
    this.duration = duration;
    this.sound = null;
    this.playing = false;
    this.loop = false;
    this.rate = 1;
    this.silentTime = 0;
    this.last = 0;
    if (audio) {
      this.sound = new Audio(URL.createObjectURL(new Blob([audio.data], { type: audio.type })));
      this.sound.preload = "metadata";
      this.sound.preservesPitch = true;
    }
  }

  // The sound may be shorter than the motion: past its end, time runs on by itself.
  get sounding() {
    return this.sound && !this.sound.error && !this.sound.ended && this.silentTime < this.soundEnd;
  }

  get soundEnd() {
    return Number.isFinite(this.sound.duration) ? this.sound.duration : Infinity;
  }

  get time() {
    return Math.min(this.silentTime, this.duration);
  }

  // Called once a drawn frame with the time in milliseconds.
  tick(now) {
    const passed = (now - this.last) / 1000;
    this.last = now;
    if (!this.playing) return;
    if (this.sounding && !this.sound.paused) this.silentTime = this.sound.currentTime;
    else if (!this.sounding) this.silentTime += passed * this.rate;
    if (this.silentTime < this.duration) return;
    if (this.loop) this.seek(0);
    else this.pause();
  }

  seek(time) {
    this.silentTime = Math.min(Math.max(time, 0), this.duration);
    if (!this.sound) return;
    this.sound.currentTime = Math.min(this.silentTime, this.soundEnd);
    if (this.playing && this.silentTime < this.soundEnd) this.startSound();
  }

  play() {
    if (this.silentTime >= this.duration) this.seek(0);
    this.playing = true;
    this.last = performance.now();
    if (this.sounding) this.startSound();
  }

  startSound() {
    this.sound.playbackRate = this.rate;
    // Refused or undecodable sound must not stop the picture.
    this.sound.play().catch(() => { this.sound = null; });
  }

  pause() {
    this.playing = false;
    this.silentTime = Math.min(this.silentTime, this.duration);
    this.sound?.pause();
  }

  setRate(rate) {
    this.rate = rate;
    if (this.sound) this.sound.playbackRate = rate;
  }
}
