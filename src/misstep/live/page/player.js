// Plays recordings: attempts and trials, at any speed, forwards, step by step and back.

import { byId, setText, show } from "misstep/dom.js";

const LINGER = 0.7; // s on the last state, before a trial counts as watched

export class Player {
  constructor(ended) {
    this.ended = ended;
    this.recording = null;
    this.position = 0;
    this.playing = false;
    byId("play").addEventListener("click", () => this.toggle());
    byId("step-back").addEventListener("click", () => this.step(-1));
    byId("step-on").addEventListener("click", () => this.step(1));
    byId("seek").addEventListener("input", (event) => {
      this.playing = false;
      this.position = (Number(event.target.value) / 1000) * this.duration;
    });
  }

  get duration() { return this.recording ? this.recording.actions.length * this.recording.dt : 0; }
  get speed() { return byId("playback").value; }
  get atEnd() { return this.position >= this.duration; }

  open(recording, playing = true) {
    this.recording = recording;
    this.linger = 0;
    this.told = false;
    this.playing = playing && this.speed !== "full";
    this.position = this.speed === "full" ? this.duration : 0;
  }

  close() {
    this.recording = null;
    this.playing = false;
  }

  toggle() {
    if (!this.recording) return;
    if (!this.playing && this.atEnd) this.position = 0;
    this.playing = !this.playing;
  }

  step(sign) {
    if (!this.recording) return;
    this.playing = false;
    const at = Math.round(this.position / this.recording.dt) + sign;
    this.position = Math.max(0, Math.min(at, this.recording.actions.length)) * this.recording.dt;
  }

  advance(seconds) {
    if (!this.recording) return;
    if (this.playing && !this.atEnd) {
      const rate = this.speed === "full" ? 1e9 : Number(this.speed);
      this.position = Math.min(this.duration, this.position + rate * seconds);
    }
    if (this.atEnd && (this.playing || this.speed === "full")) {
      this.linger += seconds;
      if (!this.told && (this.linger > LINGER || this.speed === "full")) {
        this.told = true;
        this.playing = false;
        this.ended(this.recording);
      }
    }
    this.showControls();
  }

  showControls() {
    byId("play").classList.toggle("playing", this.playing);
    const seek = byId("seek");
    const value = String(Math.round((1000 * this.position) / this.duration));
    if (seek.value !== value) seek.value = value;
    const clock = `${this.position.toFixed(2)} of ${this.duration.toFixed(2)} s`;
    if (byId("clock").textContent === clock) return;
    setText(byId("clock"), clock);
    seek.setAttribute("aria-valuetext", clock);
  }

  // The state between two observations, as it was recorded.
  view() {
    const { observations, actions, dt } = this.recording;
    const at = Math.min(this.position / dt, actions.length), k = Math.min(Math.floor(at + 1e-6), actions.length - 1);
    const share = Math.min(at - k, 1);
    const observation = observations[k].map((value, i) => {
      const next = observations[k + 1][i];
      // An angle that wraps around in between is not interpolated through half a turn.
      return Math.abs(next - value) > 4 ? (share < 0.5 ? value : next) : value + share * (next - value);
    });
    return { observation, action: actions[k], time: this.position, step: k };
  }

  showBar() {
    show(byId("player"), this.recording !== null);
  }
}
