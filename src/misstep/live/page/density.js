// The density of the actions in this very state, its donut, and the action that was chosen.

import { nameOf, prepared, shownUnit, ticks } from "misstep/dom.js";
import { font, smallSize, zoom } from "misstep/pen.js";
import { colours, faded } from "misstep/theme.js";

const POINTS = 161;

export class Density {
  constructor(canvas) {
    this.canvas = canvas;
    this.top = 0;
  }

  use(system) {
    this.system = system;
    this.top = 0;
  }

  draw(model, conditional, action) {
    const ready = prepared(this.canvas);
    if (!ready || !this.system) return;
    const { pen, width, height } = ready;
    pen.clearRect(0, 0, width, height);
    const size = smallSize(), floor = height - 2.5 * size, left = 6, right = width - 6;
    const [low, high] = [this.system.low[0] ?? -1, this.system.high[0] ?? 1];
    const span = high - low, from = low - 0.12 * span, to = high + 0.12 * span;
    const X = (a) => left + ((a - from) / (to - from)) * (right - left);
    this.drawAxis(pen, X, from, to, floor, size, left, right, height);
    if (model && conditional) {
      const grid = Array.from({ length: POINTS }, (_, i) => from + ((to - from) * i) / (POINTS - 1));
      const plain = grid.map((a) => model.gaussian(conditional, a));
      const donut = model.isScalar ? grid.map((a) => model.donut(conditional, a)) : null;
      // The scale follows slowly, or a narrow peak would make everything jump.
      const most = donut ? Math.max(...donut) : Infinity;
      const peak = Math.max(Math.min(Math.max(...plain), 2 * most), donut ? most : 0) || 1;
      this.top = this.top ? this.top + 0.15 * (peak - this.top) : peak;
      const Y = (d) => floor - Math.min(1.02, d / (1.12 * this.top)) * (floor - 6);
      this.drawCurve(pen, grid, plain, X, Y, floor, faded(colours.shown, 0.2), faded(colours.shown, 0.55), 1.2);
      if (donut) this.drawCurve(pen, grid, donut, X, Y, floor, null, colours.mix, 2.4);
    }
    this.drawChoice(pen, X(Math.min(Math.max(action, from), to)), floor);
  }

  drawAxis(pen, X, from, to, floor, size, left, right, height) {
    pen.font = font(size);
    pen.strokeStyle = faded(colours.steel, 0.7);
    pen.lineWidth = 1;
    pen.beginPath(); pen.moveTo(left, floor + 0.5); pen.lineTo(right, floor + 0.5); pen.stroke();
    pen.fillStyle = colours.faint;
    pen.textAlign = "center"; pen.textBaseline = "top";
    const marks = ticks(from, to, Math.max(2, (right - left) / 75));
    for (const a of marks.at) pen.fillText(a.toFixed(marks.digits).replace("-", "−"), X(a), floor + 4);
    const column = this.system.actions[0], unit = shownUnit(column);
    pen.textAlign = "right"; pen.textBaseline = "bottom";
    pen.fillText(`${nameOf(column)}${unit ? ` [${unit}]` : ""} →`, right, height - 1);
  }

  drawCurve(pen, grid, values, X, Y, floor, fill, stroke, thickness) {
    pen.beginPath();
    grid.forEach((a, i) => pen.lineTo(X(a), Y(values[i])));
    pen.strokeStyle = stroke;
    pen.lineWidth = thickness * zoom();
    pen.lineJoin = "round";
    pen.stroke();
    if (fill) {
      pen.lineTo(X(grid.at(-1)), floor); pen.lineTo(X(grid[0]), floor); pen.closePath();
      pen.fillStyle = fill;
      pen.fill();
    }
  }

  drawChoice(pen, x, floor) {
    pen.strokeStyle = pen.fillStyle = colours.path;
    const unit = zoom();
    pen.lineWidth = 2 * unit;
    pen.beginPath(); pen.moveTo(x, 4); pen.lineTo(x, floor); pen.stroke();
    pen.beginPath(); pen.moveTo(x, floor - 7 * unit); pen.lineTo(x - 6 * unit, floor + 2 * unit); pen.lineTo(x + 6 * unit, floor + 2 * unit); pen.closePath(); pen.fill();
  }
}
