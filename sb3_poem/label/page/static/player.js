// One video file holds both clips side by side, and perhaps a race of them: they cannot fall out of step. Each part has
// a canvas; all parts are as large as each other.
"use strict";

const SHAPE = 4 / 3; // width by height

class Player {
  constructor(canvases, controls, onError) {
    this.canvases = canvases;
    this.controls = controls;
    this.video = document.createElement("video");
    this.video.muted = true;
    this.video.loop = true;
    this.video.playsInline = true;
    this.video.preload = "auto";
    this.fps = 20;
    this.frames = 1;
    this.parts = canvases.length; // until a film says otherwise
    this.wantsToPlay = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.drawn = -1;
    this.video.addEventListener("seeked", () => this.draw());
    this.video.addEventListener("loadeddata", () => this.draw());
    this.video.addEventListener("error", () => onError("This video cannot be played here."));
    controls.play.addEventListener("click", () => this.toggle());
    controls.frame.addEventListener("input", () => this.seek(Number(controls.frame.value)));
    controls.speed.addEventListener("change", () => this.applySpeed());
    const tick = () => {
      if (!this.video.paused && this.frame !== this.drawn) this.draw();
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
    this.showState();
  }

  // Resolves once the first frame is on the screen.
  async load(url, fps, frames) {
    const response = await fetch(url);
    if (!response.ok) throw new Error("The video could not be loaded.");
    const blob = await response.blob();
    if (this.video.src) URL.revokeObjectURL(this.video.src);
    this.fps = fps;
    this.frames = frames;
    this.controls.frame.max = String(frames - 1);
    await new Promise((resolve, reject) => {
      this.video.addEventListener("loadeddata", resolve, { once: true });
      this.video.addEventListener("error", () => reject(new Error("This browser cannot play H.264 video.")), { once: true });
      this.video.src = URL.createObjectURL(blob);
    });
    this.applySpeed();
    this.draw();
    if (this.wantsToPlay) this.play();
  }

  get frame() {
    return Math.min(this.frames - 1, Math.max(0, Math.floor(this.video.currentTime * this.fps + 0.01)));
  }

  applySpeed() {
    this.video.playbackRate = Number(this.controls.speed.value);
  }

  toggle() {
    this.wantsToPlay = this.video.paused;
    if (this.wantsToPlay) this.play();
    else this.video.pause();
    this.showState();
  }

  async play() {
    try {
      await this.video.play();
    } catch (error) {
      // the browser does not let videos begin by themselves, unless it is another film that begins
      if (error.name !== "AbortError") this.wantsToPlay = false;
    }
    this.showState();
  }

  step(by) {
    this.seek((this.frame + by + this.frames) % this.frames);
  }

  seek(frame) {
    this.wantsToPlay = false;
    this.video.pause();
    this.video.currentTime = (frame + 0.5) / this.fps; // the middle of the frame, whatever the rounding
    this.showState();
  }

  draw() {
    const { videoWidth: width, videoHeight: height } = this.video;
    if (!width) return;
    this.parts = Math.round(width / (height * SHAPE));
    const part = width / this.parts;
    this.canvases.slice(0, this.parts).forEach((canvas, index) => {
      if (canvas.width !== part || canvas.height !== height) {
        canvas.width = part;
        canvas.height = height;
      }
      canvas.getContext("2d").drawImage(this.video, index * part, 0, part, height, 0, 0, part, height);
    });
    this.drawn = this.frame;
    this.controls.frame.value = String(this.drawn);
    const seconds = (this.drawn / this.fps).toFixed(1);
    this.controls.moment.textContent = `${seconds} s`;
    this.controls.frame.setAttribute("aria-valuetext", `${seconds} seconds`);
  }

  showState() {
    const playing = this.wantsToPlay;
    this.controls.play.setAttribute("aria-label", playing ? "Pause" : "Play");
    this.controls.icon.setAttribute("d", playing ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5l12 7-12 7z");
  }
}
