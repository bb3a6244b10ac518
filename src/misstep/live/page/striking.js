// Flip-up and basket: an effector strikes a block from below, or a lever from above.

import { arrow, box, world } from "misstep/pen.js";
import { colours, faded } from "misstep/theme.js";

function drawEffector(pen, place, x, z, radius, up, view, p, scale) {
  pen.strokeStyle = pen.fillStyle = colours.path;
  pen.lineWidth = 1.2 * radius * scale;
  pen.beginPath(); pen.moveTo(place.X(x), place.Y(z)); pen.lineTo(place.X(x), place.Y(z - up * 0.14)); pen.stroke();
  pen.beginPath(); pen.arc(place.X(x), place.Y(z), radius * scale, 0, 7); pen.fill();
  const reach = (0.1 * view.action[0]) / p.v_max;
  const aside = x + 2.4 * radius;
  arrow(pen, place.X(aside), place.Y(z), place.X(aside), place.Y(z + up * reach), 6, faded(colours.path, 0.85));
}

export function drawFlipUp(stage, pen, width, height, state, view) {
  const p = stage.system.parameters, u = p.block_length;
  const place = world(pen, width, height, -1.1 * u, 1.0 * u, -0.75 * u, 1.15 * u);
  const { X, Y, scale } = place;
  pen.fillStyle = faded(colours.steel, 0.8);
  box(pen, -20, Y(0), X(0) + 20, 0.14 * u * scale, 6); pen.fill();
  drawEffector(pen, place, p.effector_offset, state.position - p.effector_radius - 0.001, p.effector_radius, 1, view, p, scale);
  pen.save();
  pen.translate(X(state.block_x), Y(state.block_z));
  pen.rotate(-state.block_angle);
  const tall = p.block_height;
  pen.fillStyle = colours.shown;
  box(pen, (-0.5 * u) * scale, -0.5 * tall * scale, u * scale, tall * scale, 5); pen.fill();
  pen.fillStyle = faded(colours.card, 0.55);
  pen.fillRect(0.3 * u * scale, -0.5 * tall * scale, 0.06 * u * scale, tall * scale);
  pen.restore();
}

export function drawBasket(stage, pen, width, height, state, view) {
  const p = stage.system.parameters;
  const right = Math.max(p.basket_distance + 0.35, state.ball_x + 0.1);
  const place = world(pen, width, height, -0.5, right, -0.12, Math.max(0.62, state.ball_z + 0.1));
  const { X, Y, scale } = place;
  pen.fillStyle = faded(colours.steel, 0.18);
  pen.fillRect(0, Y(0), width, height);
  pen.strokeStyle = colours.good; pen.lineWidth = 4;
  pen.fillStyle = faded(colours.good, 0.12);
  const l = X(p.basket_distance - p.basket_half_width), r = X(p.basket_distance + p.basket_half_width);
  pen.beginPath(); pen.moveTo(l, Y(p.basket_height)); pen.lineTo(l, Y(0)); pen.lineTo(r, Y(0)); pen.lineTo(r, Y(p.basket_height));
  pen.fill(); pen.stroke();
  pen.strokeStyle = faded(colours.steel, 0.9); pen.lineWidth = 0.03 * scale;
  pen.beginPath(); pen.moveTo(X(0), Y(0)); pen.lineTo(X(0), Y(p.pivot_height)); pen.stroke();
  drawLever(pen, place, p, state.lever_angle);
  pen.fillStyle = colours.bad;
  pen.beginPath(); pen.arc(X(state.ball_x), Y(state.ball_z), p.ball_radius * scale, 0, 7); pen.fill();
  const radius = p.effector_radius, z = p.pivot_height + 0.006 + radius - state.position;
  drawEffector(pen, place, p.effector_offset, z, radius, -1, view, p, scale);
}

function drawLever(pen, place, p, angle) {
  const bend = (p.bend_deg * Math.PI) / 180, c = Math.cos(angle), s = Math.sin(angle);
  const at = (x, z) => [place.X(x * c + z * s), place.Y(p.pivot_height - x * s + z * c)];
  const cup = [-p.ball_arm * Math.cos(bend), p.ball_arm * Math.sin(bend)];
  const inCup = (a, b) => at(cup[0] + a * Math.cos(bend) + b * Math.sin(bend), cup[1] - a * Math.sin(bend) + b * Math.cos(bend));
  pen.strokeStyle = colours.cart; pen.lineWidth = 0.012 * place.scale;
  pen.beginPath(); pen.moveTo(...at(p.effector_offset / 0.85, 0)); pen.lineTo(...at(0, 0)); pen.lineTo(...at(...cup)); pen.stroke();
  pen.lineWidth = 0.006 * place.scale;
  pen.beginPath(); pen.moveTo(...inCup(-0.03, 0.026));
  for (const corner of [[-0.03, -0.003], [0.03, -0.003], [0.03, 0.014]]) pen.lineTo(...inCup(...corner));
  pen.stroke();
  pen.fillStyle = colours.steel;
  pen.beginPath(); pen.arc(place.X(0), place.Y(p.pivot_height), 0.012 * place.scale, 0, 7); pen.fill();
}
