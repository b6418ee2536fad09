// The strip under the time line, on one time axis: speech with its onsets, its spectrogram, hand
// speed with its beats, and when the feet stand.

function tickStep(duration, width) {
  const wanted = (duration * 90) / width;
  return [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600].find((s) => s >= wanted) ?? 1200;
}

export class Strip {
  constructor(canvas, page, duration) {
    this.canvas = canvas;
    this.page = page;
    this.duration = duration;
    this.picture = document.createElement("canvas");
    this.spectrum = page.speech && spectrumPicture(page.speech.spectrum);
    this.resize();
  }

  resize() {
    const scale = (this.scale = window.devicePixelRatio || 1);
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    for (const canvas of [this.canvas, this.picture]) {
      canvas.width = Math.max(1, Math.round(this.width * scale));
      canvas.height = Math.max(1, Math.round(this.height * scale));
      canvas.getContext("2d").setTransform(scale, 0, 0, scale, 0, 0);
    }
    this.paint();
  }

  x(time) {
    return (time / this.duration) * this.width;
  }

  paint() {
    this.drawn = null;
    const c = this.picture.getContext("2d");
    const { width, height, page } = this;
    const style = getComputedStyle(document.documentElement);
    for (const name of ["ink", "soft", "line", "panel", "speech"]) this[name] = style.getPropertyValue(`--${name}`);
    c.clearRect(0, 0, width, height);
    const foot = height - 15;
    const isLow = height < 90; // no room for everything
    const standing = isLow ? [] : page.figures.filter((figure) => figure.contacts);
    const ground = foot - 7 * standing.length - (standing.length ? 3 : 0);
    const middle = page.speech ? Math.round(ground * (isLow ? 0.46 : 0.56)) : 0;
    const wave = isLow ? middle : Math.round(middle / 2);
    c.font = "11px system-ui, sans-serif";
    this.paintAxis(c, foot);
    if (page.speech) {
      this.paintSpeech(c, 2, wave - 2);
      if (!isLow) this.paintSpectrum(c, wave, middle - 2);
    }
    // One broken figure, many times as fast as the others, may not flatten their curves: it is cut.
    const peaks = page.figures.map((figure) => figure.speed.peak).sort((a, b) => a - b);
    const top = Math.min(peaks.at(-1), 2 * peaks[(peaks.length - 1) >> 1] || Infinity) || 1;
    for (const figure of page.figures) this.paintSpeed(c, figure, top, middle + 2, ground);
    standing.forEach((figure, i) => this.paintContacts(c, figure, ground + 3 + 7 * i));
    if (page.speech) this.label(c, "speech", 11);
    const cut = top < peaks.at(-1) ? "; faster motion is cut" : "";
    this.label(c, `${page.figures[0].speed.of}, up to ${speed(top)}${cut}`, middle + 13);
    if (standing.length) this.label(c, "feet on the ground", ground - 1);
  }

  paintSpectrum(c, top, bottom) {
    const { canvas, seconds } = this.spectrum;
    c.imageSmoothingEnabled = true;
    c.drawImage(canvas, 0, top, this.x(seconds), bottom - top);
  }

  // The left foot above, the right foot below.
  paintContacts(c, { contacts, fps, ink }, top) {
    c.fillStyle = ink;
    for (const foot of [0, 1]) {
      for (let t = 0, from = -1; t <= contacts.length; t++) {
        const stands = (contacts[t] >> foot) & 1;
        if (stands && from < 0) from = t;
        if (stands || from < 0) continue;
        c.fillRect(this.x(from / fps), top + 3 * foot, Math.max(0.5, this.x((t - from) / fps)), 2);
        from = -1;
      }
    }
  }

  // Ticks at `times` seconds, unless there are too many to tell apart.
  paintTicks(c, times, top, bottom) {
    if (times.length * 4 > this.width) return;
    for (const time of times) c.fillRect(this.x(time) - 0.5, top, 1, bottom - top);
  }

  label(c, text, y) {
    c.globalAlpha = 0.8;
    c.fillStyle = this.panel;
    c.fillRect(0, y - 10, c.measureText(text).width + 8, 14);
    c.globalAlpha = 1;
    c.fillStyle = this.soft;
    c.fillText(text, 3, y);
  }

  paintAxis(c, foot) {
    c.strokeStyle = this.line;
    c.fillStyle = this.soft;
    const step = tickStep(this.duration, this.width);
    for (let t = 0; t <= this.duration + 1e-6; t += step) {
      const x = Math.round(this.x(t)) + 0.5;
      c.beginPath();
      c.moveTo(x, 0);
      c.lineTo(x, foot);
      c.stroke();
      const text = t >= 60 ? `${Math.floor(t / 60)}:${String(t % 60).padStart(2, "0")}` : `${+t.toFixed(1)} s`;
      const place = x + c.measureText(text).width / 2 > this.width ? "right" : t === 0 ? "left" : "center";
      c.textAlign = place;
      c.fillText(text, x, this.height - 3);
    }
    c.textAlign = "left";
  }

  // The largest of the values that fall on each pixel column, 0 to 255.
  columns(values, rate) {
    const n = Math.ceil(this.width);
    const out = new Uint8Array(n);
    for (let i = 0; i < n; i++) {
      const from = Math.floor((i / this.width) * this.duration * rate);
      const to = Math.max(from + 1, Math.ceil(((i + 1) / this.width) * this.duration * rate));
      for (let k = from; k < Math.min(to, values.length); k++) out[i] = Math.max(out[i], values[k]);
    }
    return out;
  }

  paintSpeech(c, top, bottom) {
    const half = (bottom - top) / 2;
    c.fillStyle = this.speech;
    this.columns(this.page.speech.peaks, this.page.speech.rate).forEach((value, x) => {
      // Bent upwards, or the quiet half of speech could not be seen.
      const h = Math.max(0.5, (value / 255) ** 0.6 * half);
      c.fillRect(x, top + half - h, 1, 2 * h);
    });
    c.fillStyle = this.ink;
    this.paintTicks(c, this.page.speech.onsets, bottom - 4, bottom);
  }

  paintSpeed(c, figure, peak, top, bottom) {
    const { values, peak: own } = figure.speed;
    c.beginPath();
    c.moveTo(0, bottom);
    const n = values.length;
    for (let k = 0; k < n; k++) {
      const y = bottom - Math.min(1, (values[k] / 255) * (own / peak)) * (bottom - top);
      c.lineTo(this.x(k / figure.fps), y);
    }
    c.strokeStyle = figure.ink;
    c.lineWidth = 1.5;
    c.lineJoin = "round";
    c.stroke();
    c.lineTo(this.x((n - 1) / figure.fps), bottom);
    c.closePath();
    c.globalAlpha = 0.2;
    c.fillStyle = figure.ink;
    c.fill();
    c.globalAlpha = 1;
    c.lineWidth = 1;
    this.paintTicks(c, figure.beats, bottom - 4, bottom);
  }

  // Draw the playhead, if it moved by a pixel or the picture was painted again.
  draw(time) {
    const { width, height, scale } = this;
    const x = Math.round(this.x(time) * scale) / scale;
    if (x === this.drawn) return;
    this.drawn = x;
    const c = this.canvas.getContext("2d");
    c.clearRect(0, 0, width, height);
    c.drawImage(this.picture, 0, 0, width, height);
    c.fillStyle = "rgba(47, 111, 159, .09)";
    c.fillRect(0, 0, x, height - 15);
    c.fillStyle = this.ink;
    c.fillRect(Math.min(Math.max(x - 0.75, 0), width - 1.5), 0, 1.5, height - 13);
  }
}

// The spectrogram as a canvas of one pixel a value, low bands at the bottom.
function spectrumPicture({ bands, rate, values }) {
  const canvas = document.createElement("canvas");
  const columns = values.length / bands;
  canvas.width = columns;
  canvas.height = bands;
  const c = canvas.getContext("2d");
  const image = c.createImageData(columns, bands);
  for (let t = 0; t < columns; t++) {
    for (let band = 0; band < bands; band++) {
      const at = 4 * ((bands - 1 - band) * columns + t);
      image.data.set([74, 134, 178, values[t * bands + band]], at);
    }
  }
  c.putImageData(image, 0, 0);
  return { canvas, seconds: columns / rate };
}

// In words that an idle body has too: "0.0 m/s" would say that it does not move at all.
function speed(top) {
  if (top < 5e-4) return "0 m/s";
  if (top < 0.1) return `${(100 * top).toFixed(top < 0.01 ? 1 : 0)} cm/s`;
  return `${top.toFixed(1)} m/s`;
}
