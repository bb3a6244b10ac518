// A system of which nothing but its columns is known: each as a bar.

import { fontSize, inShownUnit, nameOf, signed, withUnit } from "misstep/dom.js";
import { box, font, zoom } from "misstep/pen.js";
import { colours, faded } from "misstep/theme.js";

export function drawColumns(stage, pen, width, height, state, view) {
  const columns = stage.system.columns, size = Math.max(12, 0.86 * fontSize());
  stage.range ??= columns.map(() => 1e-6);
  const shown = columns.slice(0, 12), actions = stage.system.actions.slice(0, 4);
  const rows = shown.length + actions.length, row = Math.min(46 * zoom(), (height - 16) / rows);
  const left = Math.min(190 * zoom(), 0.34 * width), right = width - Math.min(120 * zoom(), 0.24 * width), middle = (left + right) / 2;
  const top = (height - rows * row) / 2;
  pen.font = font(size);
  pen.textBaseline = "middle";
  const line = (i, column, value, most, colour, signedRange) => {
    const y = top + (i + 0.5) * row, half = (right - left) / 2;
    pen.textAlign = "right"; pen.fillStyle = colours.faint;
    pen.fillText(nameOf(column), left - 12, y);
    pen.fillStyle = faded(colours.steel, 0.2);
    box(pen, left, y - 0.17 * row, right - left, 0.34 * row, 0.17 * row); pen.fill();
    const origin = signedRange ? middle : left, span = signedRange ? half : 2 * half;
    const end = origin + Math.max(-1, Math.min(1, value / most)) * span;
    pen.fillStyle = colour;
    box(pen, Math.min(origin, end), y - 0.17 * row, Math.max(2, Math.abs(end - origin)), 0.34 * row, 3); pen.fill();
    pen.textAlign = "left"; pen.fillStyle = colours.ink;
    pen.fillText(withUnit(signed(inShownUnit(column, value), 2), column), right + 12, y);
  };
  shown.forEach((column, i) => {
    const value = state[column.name];
    stage.range[i] = Math.max(stage.range[i], Math.abs(value));
    line(i, column, value, stage.range[i], colours.shown, true);
  });
  actions.forEach((column, j) => {
    const { low, high } = stage.system;
    const most = Math.max(Math.abs(low[j] ?? 1), Math.abs(high[j] ?? 1));
    line(shown.length + j, column, view.action[j], most, colours.path, (low[j] ?? -1) < 0);
  });
}
