// The plane of one column of the state and the action: data, ellipses, the path being taken.
// What stands still is drawn once and kept, so that a frame costs one copy and one path.

import { inShownUnit, nameOf, prepared, shownUnit, ticks } from "misstep/dom.js";
import { font, smallSize, zoom } from "misstep/pen.js";
import { colours, faded } from "misstep/theme.js";

const MOST_POINTS = 40000;

export class Plane {
  constructor(canvas) {
    this.canvas = canvas;
    this.still = document.createElement("canvas");
    this.shown = [];
    this.tried = [];
    this.model = null;
    this.stale = true;
  }

  use(system) {
    this.system = system;
    this.column = system.main;
    this.change({ shown: [], tried: [], model: null });
  }

  // shown, tried: recordings of the demonstrations and of the trials before.
  change(what) {
    Object.assign(this, what);
    this.stale = true;
  }

  draw(path, until, action) {
    const ready = prepared(this.canvas);
    if (!ready || !this.system) return;
    const { pen, width, height, ratio, resized } = ready;
    if (this.stale || resized) this.drawStill(width, height, ratio);
    // Dot for dot, or what stands still would be blurred.
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    pen.drawImage(this.still, 0, 0);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (!path || !path.observations.length) return;
    const i = this.index, scale = this.unit;
    pen.save();
    pen.beginPath(); pen.rect(...this.inside); pen.clip();
    pen.strokeStyle = faded(colours.path, 0.85);
    pen.lineWidth = 2 * this.zoom;
    pen.lineJoin = "round";
    pen.beginPath();
    const last = Math.min(until, path.actions.length - 1), first = Math.max(0, last - 3000);
    for (let t = first; t <= last; t++) {
      const x = this.X(path.observations[t][i] * scale), y = this.Y(path.actions[t][0]);
      if (t === first || Math.abs(path.observations[t][i] - path.observations[t - 1][i]) > 4) pen.moveTo(x, y);
      else pen.lineTo(x, y);
    }
    pen.stroke();
    pen.restore();
    const state = path.observations[Math.min(until, path.observations.length - 1)];
    this.drawHead(pen, this.X(state[i] * scale), this.Y(action[0]));
  }

  drawHead(pen, x, y) {
    const [left, top, w, t] = this.inside;
    const cx = Math.min(Math.max(x, left), left + w), cy = Math.min(Math.max(y, top), top + t);
    pen.fillStyle = colours.path;
    pen.strokeStyle = colours.card;
    pen.lineWidth = 2.5 * this.zoom;
    pen.beginPath(); pen.arc(cx, cy, 7 * this.zoom, 0, 7); pen.fill(); pen.stroke();
  }

  drawStill(width, height, ratio) {
    this.stale = false;
    this.zoom = zoom();
    this.still.width = Math.round(width * ratio);
    this.still.height = Math.round(height * ratio);
    const pen = this.still.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const column = this.system.columns.find((c) => c.name === this.column) ?? this.system.columns[0];
    this.index = this.system.columns.indexOf(column);
    this.unit = inShownUnit(column, 1);
    this.findRange(column);
    this.drawAxes(pen, width, height, column);
    pen.save();
    pen.beginPath(); pen.rect(...this.inside); pen.clip();
    const total = [...this.shown, ...this.tried].reduce((n, r) => n + r.actions.length, 0);
    const stride = Math.max(1, Math.ceil(total / MOST_POINTS));
    this.drawPoints(pen, this.tried, faded(colours.path, 0.28), 1.3 * this.zoom, stride, true);
    this.drawPoints(pen, this.shown, faded(colours.shown, 0.5), 1.7 * this.zoom, stride, false);
    for (const ellipse of this.model?.ellipses(column.name) ?? []) this.drawEllipse(pen, ellipse);
    pen.restore();
  }

  findRange(column) {
    const values = [];
    for (const recording of [...this.shown, ...this.tried]) {
      const stride = Math.max(1, Math.floor(recording.observations.length / 400));
      for (let t = 0; t < recording.observations.length; t += stride) values.push(recording.observations[t][this.index] * this.unit);
    }
    values.sort((a, b) => a - b);
    const at = (q) => values[Math.min(values.length - 1, Math.floor(q * values.length))];
    let low = values.length ? at(0.004) : -1, high = values.length ? at(0.996) : 1;
    if (column.unit === "rad" && !values.length) high = -(low = this.system.parameters.fall_angle_deg > 90 ? -180 : -30);
    const margin = Math.max(0.06 * (high - low), 1e-3 * this.unit);
    this.low = low - margin; this.high = high + margin;
    const [down, up] = [this.system.low[0] ?? -1, this.system.high[0] ?? 1];
    this.down = down - 0.07 * (up - down); this.up = up + 0.07 * (up - down);
  }

  drawAxes(pen, width, height, column) {
    const size = smallSize();
    const left = 3.1 * size, bottom = 2.5 * size, top = 0.6 * size;
    this.inside = [left, top, width - left - 6, height - bottom - top];
    const [x0, y0, w, t] = this.inside;
    this.X = (x) => x0 + ((x - this.low) / (this.high - this.low)) * w;
    this.Y = (a) => y0 + t - ((a - this.down) / (this.up - this.down)) * t;
    pen.font = font(size);
    pen.lineWidth = 1;
    pen.strokeStyle = colours.line;
    pen.fillStyle = colours.faint;
    pen.textAlign = "center"; pen.textBaseline = "top";
    const across = ticks(this.low, this.high, Math.max(3, w / 90)), along = ticks(this.down, this.up, Math.max(3, t / 60));
    pen.beginPath();
    for (const x of across.at) { pen.moveTo(Math.round(this.X(x)) + 0.5, y0); pen.lineTo(Math.round(this.X(x)) + 0.5, y0 + t); }
    for (const a of along.at) { pen.moveTo(x0, Math.round(this.Y(a)) + 0.5); pen.lineTo(x0 + w, Math.round(this.Y(a)) + 0.5); }
    pen.stroke();
    pen.strokeStyle = faded(colours.steel, 0.7);
    pen.beginPath();
    if (this.low < 0 && this.high > 0) { pen.moveTo(this.X(0), y0); pen.lineTo(this.X(0), y0 + t); }
    if (this.down < 0 && this.up > 0) { pen.moveTo(x0, this.Y(0)); pen.lineTo(x0 + w, this.Y(0)); }
    pen.stroke();
    for (const x of across.at) pen.fillText(x.toFixed(across.digits).replace("-", "−"), this.X(x), y0 + t + 4);
    pen.textAlign = "right"; pen.textBaseline = "middle";
    for (const a of along.at) pen.fillText(a.toFixed(along.digits).replace("-", "−"), x0 - 6, this.Y(a));
    pen.textAlign = "right"; pen.textBaseline = "bottom";
    const unit = shownUnit(column), action = this.system.actions[0];
    pen.fillText(`${nameOf(column)}${unit ? ` [${unit}]` : ""} →`, x0 + w, height - 1);
    pen.textAlign = "left";
    pen.fillText(`↑ ${nameOf(action)}${action.unit ? ` [${shownUnit(action)}]` : ""}`, x0, height - 1);
  }

  drawPoints(pen, recordings, colour, radius, stride, square) {
    pen.fillStyle = colour;
    for (const { observations, actions } of recordings) {
      for (let t = 0; t < actions.length; t += stride) {
        const x = this.X(observations[t][this.index] * this.unit), y = this.Y(actions[t][0]);
        if (square) pen.fillRect(x - radius, y - radius, 2 * radius, 2 * radius);
        else { pen.beginPath(); pen.arc(x, y, radius, 0, 7); pen.fill(); }
      }
    }
  }

  drawEllipse(pen, { centre, covariance: [a, b, c], deviations, weight }) {
    // Points of the ellipse through the Cholesky factor, each brought to the screen.
    const l = Math.sqrt(a), m = b / l, n = Math.sqrt(Math.max(c - m * m, 0));
    pen.beginPath();
    for (let i = 0; i <= 72; i++) {
      const s = deviations * Math.cos((i * Math.PI) / 36), r = deviations * Math.sin((i * Math.PI) / 36);
      pen.lineTo(this.X((centre[0] + l * s) * this.unit), this.Y(centre[1] + m * s + n * r));
    }
    pen.closePath();
    pen.fillStyle = faded(colours.mix, 0.05 + 0.12 * weight);
    pen.fill();
    pen.strokeStyle = colours.mix;
    pen.lineWidth = 1.7 * this.zoom;
    pen.stroke();
    const x = this.X(centre[0] * this.unit), y = this.Y(centre[1]);
    const arm = 4 * this.zoom;
    pen.beginPath(); pen.moveTo(x - arm, y); pen.lineTo(x + arm, y); pen.moveTo(x, y - arm); pen.lineTo(x, y + arm);
    pen.stroke();
  }
}
