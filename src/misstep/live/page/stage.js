// What a state looks like. Cart-poles, flip-up and basket are drawn; any other system is shown as
// what it observes, column by column.

import { inShownUnit, nameOf, prepared, shownUnit, signed, fontSize } from "misstep/dom.js";
import { colours, faded } from "misstep/theme.js";

const TRAIL = 0.7; // s of the tip's way that stays in sight
const DEAD_ZONE = 0.16; // of the width, in which the cart moves and the camera does not

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.camera = 0;
    this.trail = [];
  }

  use(system) {
    this.system = system;
    this.trail = [];
    this.range = null;
    this.names = system.columns.map((column) => column.name);
    this.reset();
  }

  reset() {
    this.trail = [];
    this.camera = 0;
  }

  // Where on the rail a place on the screen is, in m; null where that has no meaning.
  placeAt(clientX) {
    if (!this.scale) return null;
    const box = this.canvas.getBoundingClientRect();
    return this.camera + (clientX - box.left - box.width / 2) / this.scale;
  }

  draw(view) {
    const ready = prepared(this.canvas);
    if (!ready || !this.system) return;
    const { pen, width, height } = ready;
    pen.clearRect(0, 0, width, height);
    const state = Object.fromEntries(this.names.map((name, i) => [name, view.observation[i]]));
    pen.lineJoin = pen.lineCap = "round";
    const draw = { cartpole: drawCartPole, flipup: drawFlipUp, basket: drawBasket }[this.system.drawing];
    (draw ?? drawColumns)(this, pen, width, height, state, view);
  }
}

function arrow(pen, x0, y0, x1, y1, thickness, colour) {
  const length = Math.hypot(x1 - x0, y1 - y0);
  if (length < 3) return;
  const head = Math.min(length, 3.1 * thickness), ux = (x1 - x0) / length, uy = (y1 - y0) / length;
  pen.strokeStyle = pen.fillStyle = colour;
  pen.lineWidth = thickness;
  pen.lineCap = "butt";
  if (length > head) {
    pen.beginPath(); pen.moveTo(x0, y0); pen.lineTo(x1 - ux * head * 0.9, y1 - uy * head * 0.9); pen.stroke();
  }
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x1 - ux * head - uy * head * 0.62, y1 - uy * head + ux * head * 0.62);
  pen.lineTo(x1 - ux * head + uy * head * 0.62, y1 - uy * head - ux * head * 0.62);
  pen.closePath(); pen.fill();
  pen.lineCap = "round";
}

function box(pen, x, y, w, t, radius) {
  pen.beginPath();
  pen.roundRect(x, y, w, t, radius);
}

// ---------------------------------------------------------------------------------- cart-poles

function drawCartPole(stage, pen, width, height, state, view) {
  const p = stage.system.parameters, u = p.half_length;
  const limit = Math.min(p.rail, p.track_limit || Infinity);
  const swings = p.fall_angle_deg > 90;
  const above = swings ? 2.3 * u : 2.42 * u, below = swings ? 2.5 * u : 0.95 * u;
  let scale = Math.min(height / (above + below), width / (3.6 * u));
  const whole = 2 * (limit + 0.75 * u);
  const fits = width / whole > 0.42 * scale;
  if (fits) scale = Math.min(scale, width / whole);
  stage.scale = scale;
  if (fits) stage.camera = 0;
  else follow(stage, state.x, width / scale);
  const slack = height - (above + below) * scale;
  const X = (x) => width / 2 + (x - stage.camera) * scale;
  const hingeY = above * scale + 0.5 * slack;
  const size = Math.max(11, 0.74 * fontSize());

  drawGround(stage, pen, width, height, X, hingeY, scale, u, limit, size);
  const fallen = Math.abs(state.theta) > (p.fall_angle_deg * Math.PI) / 180;
  if (!swings) drawWedge(pen, X(state.x), hingeY, 2.05 * u * scale, p.fall_angle_deg, state.theta);
  drawTrail(stage, pen, state, view, X, hingeY, scale, u);
  drawCart(pen, X(state.x), hingeY, scale * u, state.x / (0.09 * u));
  drawPole(pen, X(state.x), hingeY, scale * u, state.theta, fallen);
  if (view.hand !== null && view.hand !== undefined) {
    drawSpring(pen, X(state.x + 2 * u * Math.sin(state.theta)), hingeY - 2 * u * Math.cos(state.theta) * scale,
      X(view.hand), hingeY - 2 * u * Math.cos(state.theta) * scale);
  }
  const share = Math.max(-1, Math.min(1, view.action[0] / p.force_limit));
  if (Math.abs(share) > 0.02) {
    const start = X(state.x) + Math.sign(share) * 0.44 * u * scale;
    const end = start + share * 1.5 * u * scale;
    arrow(pen, start, hingeY, end, hingeY, Math.max(5, 0.075 * u * scale), colours.path);
    pen.fillStyle = colours.path;
    pen.font = `600 ${size}px ${fontFamily()}`;
    pen.textAlign = share > 0 ? "left" : "right";
    pen.textBaseline = "bottom";
    pen.fillText(`${Math.abs(view.action[0]).toFixed(1)} N`, start, hingeY - Math.max(10, 0.14 * u * scale));
  }
}

let family = "";
const fontFamily = () => (family ||= getComputedStyle(document.body).fontFamily);

function follow(stage, x, seen) {
  const free = DEAD_ZONE * seen;
  if (Math.abs(x - stage.camera) > seen) stage.camera = x;
  stage.camera = Math.min(Math.max(stage.camera, x - free), x + free);
}

function drawGround(stage, pen, width, height, X, hingeY, scale, u, limit, size) {
  const top = hingeY + 0.25 * u * scale, thick = Math.max(5, 0.11 * u * scale);
  const half = width / 2 / scale, c = stage.camera;
  const step = scale > 60 ? 0.5 : scale > 24 ? 1 : 2;
  pen.fillStyle = faded(colours.steel, 0.1);
  pen.fillRect(0, top + thick, width, height - top - thick);
  // Lines behind, so that one sees the cart move where the camera goes along.
  pen.strokeStyle = faded(colours.steel, 0.16);
  pen.lineWidth = 1;
  pen.beginPath();
  for (let k = Math.ceil((c - half) / step); k * step <= c + half; k++) {
    const x = Math.round(X(k * step)) + 0.5;
    pen.moveTo(x, 0); pen.lineTo(x, top);
  }
  pen.stroke();
  const edge = Number.isFinite(limit) ? limit + 0.42 * u : Infinity;
  const left = Math.max(X(-Math.min(edge, 1e4)), -40), right = Math.min(X(Math.min(edge, 1e4)), width + 40);
  pen.fillStyle = faded(colours.steel, 0.75);
  box(pen, left, top, right - left, thick, thick / 2);
  pen.fill();
  pen.fillStyle = colours.faint;
  pen.font = `${size}px ${fontFamily()}`;
  pen.textAlign = "center"; pen.textBaseline = "top";
  for (let k = Math.ceil((c - half) / 0.1); k * 0.1 <= c + half; k++) {
    const place = k / 10, major = k % Math.round(step * 10) === 0;
    if (Math.abs(place) > edge || (!major && scale < 90)) continue;
    pen.fillStyle = faded(colours.steel, major ? 0.9 : 0.4);
    pen.fillRect(X(place) - 0.75, top + thick + 3, 1.5, major ? 8 : 4);
    if (major && k % Math.round(step * 20) === 0) {
      pen.fillStyle = colours.faint;
      pen.fillText(`${String(place).replace("-", "−")} m`, X(place), top + thick + 14);
    }
  }
  if (stage.system.parameters.track_limit || stage.system.parameters.rail < 50) {
    for (const side of [-1, 1]) drawStop(pen, X(side * limit), side, top, thick, scale * u);
  }
}

function drawStop(pen, x, side, top, thick, u) {
  pen.fillStyle = faded(colours.bad, 0.13);
  pen.fillRect(side > 0 ? x : x - 4000, top - 0.9 * u, 4000, 0.9 * u + thick);
  pen.strokeStyle = colours.bad;
  pen.lineWidth = 2;
  pen.setLineDash([6, 5]);
  pen.beginPath(); pen.moveTo(x, top - 0.9 * u); pen.lineTo(x, top + thick); pen.stroke();
  pen.setLineDash([]);
}

function drawWedge(pen, x, y, length, degrees, theta) {
  const angle = (degrees * Math.PI) / 180;
  for (const side of [-1, 1]) {
    const near = Math.max(0, Math.min(1, (side * theta) / angle));
    pen.strokeStyle = near > 0.5 ? faded(colours.bad, 0.25 + 0.6 * near) : faded(colours.steel, 0.55);
    pen.lineWidth = 1.5 + near;
    pen.setLineDash([5, 6]);
    pen.beginPath();
    pen.moveTo(x + 0.28 * length * Math.sin(side * angle), y - 0.28 * length * Math.cos(angle));
    pen.lineTo(x + length * Math.sin(side * angle), y - length * Math.cos(angle));
    pen.stroke();
  }
  pen.setLineDash([]);
}

function drawTrail(stage, pen, state, view, X, hingeY, scale, u) {
  const trail = stage.trail, last = trail.at(-1);
  if (last && (view.time < last.time || view.time > last.time + 1)) trail.length = 0;
  if (!last || view.time > last.time) trail.push({ time: view.time, x: state.x, theta: state.theta });
  while (trail.length && trail[0].time < view.time - TRAIL) trail.shift();
  pen.lineWidth = Math.max(2, 0.03 * u * scale);
  for (let i = 1; i < trail.length; i++) {
    pen.strokeStyle = faded(colours.shown, 0.42 * (1 - (view.time - trail[i].time) / TRAIL));
    pen.beginPath();
    for (const point of [trail[i - 1], trail[i]]) {
      const x = X(point.x + 2 * u * Math.sin(point.theta)), y = hingeY - 2 * u * Math.cos(point.theta) * scale;
      if (point === trail[i]) pen.lineTo(x, y); else pen.moveTo(x, y);
    }
    pen.stroke();
  }
}

function drawCart(pen, x, y, u, turned) {
  const half = 0.38 * u, tall = 0.155 * u, wheel = 0.095 * u;
  for (const side of [-1, 1]) {
    const cx = x + side * 0.22 * u, cy = y + 0.25 * u - wheel;
    pen.fillStyle = colours.cart;
    pen.beginPath(); pen.arc(cx, cy, wheel, 0, 7); pen.fill();
    pen.strokeStyle = colours.card;
    pen.lineWidth = Math.max(1.5, 0.02 * u);
    for (const spoke of [0, Math.PI / 2]) {
      const dx = Math.cos(turned + spoke) * wheel * 0.58, dy = Math.sin(turned + spoke) * wheel * 0.58;
      pen.beginPath(); pen.moveTo(cx - dx, cy - dy); pen.lineTo(cx + dx, cy + dy); pen.stroke();
    }
  }
  pen.fillStyle = colours.cart;
  box(pen, x - half, y - tall, 2 * half, 1.75 * tall, 0.09 * u);
  pen.fill();
  pen.fillStyle = faded(colours.card, 0.14);
  box(pen, x - half, y - tall, 2 * half, 0.55 * tall, 0.09 * u);
  pen.fill();
}

function drawPole(pen, x, y, u, theta, fallen) {
  const tipX = x + 2 * u * Math.sin(theta), tipY = y - 2 * u * Math.cos(theta);
  pen.strokeStyle = fallen ? colours.bad : colours.shown;
  pen.lineWidth = Math.max(5, 0.1 * u);
  pen.beginPath(); pen.moveTo(x, y); pen.lineTo(tipX, tipY); pen.stroke();
  pen.strokeStyle = faded("#ffffff", 0.28);
  pen.lineWidth = Math.max(1.5, 0.028 * u);
  pen.beginPath();
  pen.moveTo(x + 0.16 * u * Math.sin(theta), y - 0.16 * u * Math.cos(theta));
  pen.lineTo(tipX, tipY); pen.stroke();
  pen.fillStyle = colours.card; pen.strokeStyle = colours.cart;
  pen.lineWidth = Math.max(2, 0.035 * u);
  pen.beginPath(); pen.arc(x, y, Math.max(4, 0.075 * u), 0, 7); pen.fill(); pen.stroke();
}

function drawSpring(pen, x0, y0, x1, y1) {
  const turns = 9, amplitude = 6;
  pen.strokeStyle = colours.good;
  pen.lineWidth = 2;
  pen.beginPath(); pen.moveTo(x0, y0);
  for (let i = 1; i < turns * 2; i++) {
    pen.lineTo(x0 + ((x1 - x0) * i) / (turns * 2), y0 + (y1 - y0) * (i / (turns * 2)) + (i % 2 ? amplitude : -amplitude));
  }
  pen.lineTo(x1, y1); pen.stroke();
  pen.fillStyle = colours.good;
  pen.beginPath(); pen.arc(x1, y1, 8, 0, 7); pen.fill();
}

// ------------------------------------------------------------------------- flip-up and basket

function world(pen, width, height, left, right, low, high) {
  const scale = Math.min(width / (right - left), height / (high - low));
  const X = (x) => width / 2 + (x - (left + right) / 2) * scale;
  const Y = (z) => height / 2 - (z - (low + high) / 2) * scale;
  return { scale, X, Y };
}

function drawEffector(pen, place, x, z, radius, up, view, p, scale) {
  pen.strokeStyle = pen.fillStyle = colours.path;
  pen.lineWidth = 1.2 * radius * scale;
  pen.beginPath(); pen.moveTo(place.X(x), place.Y(z)); pen.lineTo(place.X(x), place.Y(z - up * 0.14)); pen.stroke();
  pen.beginPath(); pen.arc(place.X(x), place.Y(z), radius * scale, 0, 7); pen.fill();
  const reach = (0.1 * view.action[0]) / p.v_max;
  const aside = x + 2.4 * radius;
  arrow(pen, place.X(aside), place.Y(z), place.X(aside), place.Y(z + up * reach), 6, faded(colours.path, 0.85));
}

function drawFlipUp(stage, pen, width, height, state, view) {
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

function drawBasket(stage, pen, width, height, state, view) {
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

// ------------------------------------------------------------------------------ anything else

function drawColumns(stage, pen, width, height, state, view) {
  const columns = stage.system.columns, size = Math.max(12, 0.86 * fontSize());
  stage.range ??= columns.map(() => 1e-6);
  const shown = columns.slice(0, 12), actions = stage.system.actions.slice(0, 4);
  const rows = shown.length + actions.length, row = Math.min(46, (height - 70) / rows);
  const left = Math.min(190, 0.34 * width), right = width - Math.min(110, 0.2 * width), middle = (left + right) / 2;
  pen.font = `${size}px ${fontFamily()}`;
  pen.textBaseline = "middle";
  const line = (i, column, value, most, colour, signedRange) => {
    const y = 56 + (i + 0.5) * row, half = (right - left) / 2;
    pen.textAlign = "right"; pen.fillStyle = colours.faint;
    pen.fillText(nameOf(column), left - 12, y);
    pen.fillStyle = faded(colours.steel, 0.2);
    box(pen, left, y - 0.17 * row, right - left, 0.34 * row, 0.17 * row); pen.fill();
    const origin = signedRange ? middle : left, span = signedRange ? half : 2 * half;
    const end = origin + Math.max(-1, Math.min(1, value / most)) * span;
    pen.fillStyle = colour;
    box(pen, Math.min(origin, end), y - 0.17 * row, Math.max(2, Math.abs(end - origin)), 0.34 * row, 3); pen.fill();
    pen.textAlign = "left"; pen.fillStyle = colours.ink;
    pen.fillText(`${signed(inShownUnit(column, value), 2)} ${shownUnit(column)}`, right + 12, y);
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
