// Small helpers: elements by id, elements from words, numbers as people read them.

export const byId = (id) => document.getElementById(id);

export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && key !== "list") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

// Set what an element holds only where that differs: what stands still must not flicker.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function show(element, visible) {
  if (element.hidden === visible) element.hidden = !visible;
}

const isAngle = (column) => column.unit === "rad" || column.unit === "rad/s";
export const inShownUnit = (column, value) => (isAngle(column) ? (value * 180) / Math.PI : value);
export const shownUnit = (column) =>
  column.unit === "rad" ? "°" : column.unit === "rad/s" ? "°/s" : column.unit;

const NAMES = {
  x: "position", x_dot: "velocity", theta: "angle", theta_dot: "turning",
  force: "force", lever_angle: "lever", ball_x: "ball across", ball_z: "ball up",
};
export const nameOf = (column) => NAMES[column.name] ?? column.name.replaceAll("_", " ");

export function signed(value, digits = 1) {
  const text = Math.abs(value).toFixed(digits);
  if (Number(text) === 0) return text;
  return (value < 0 ? "−" : "+") + text;
}

// A number with its unit; units that are multiples themselves, such as "500 N", are multiplied.
export function withUnit(text, column) {
  const unit = shownUnit(column);
  if (!unit) return text;
  return /^\d/.test(unit) ? `${text} × ${unit}` : unit === "°" ? `${text}°` : `${text} ${unit}`;
}

export function brief(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  const text = size >= 100 ? value.toFixed(0) : size >= 1 ? value.toFixed(1) : value.toPrecision(2);
  return text.replace("-", "−");
}

export const GLYPHS = { failure: "✕", success: "✓", unknown: "?" };

// A canvas as sharp as the screen; returns its pen and size in CSS pixels, null where unseen.
export function prepared(canvas) {
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return null;
  const ratio = Math.min(globalThis.devicePixelRatio || 1, 3);
  const w = Math.round(width * ratio), t = Math.round(height * ratio);
  let resized = false;
  if (canvas.width !== w || canvas.height !== t) {
    canvas.width = w; canvas.height = t; resized = true;
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { pen, width, height, ratio, resized };
}

// The size of the page's type, px, by which everything on canvases is scaled.
export const fontSize = () => parseFloat(getComputedStyle(document.documentElement).fontSize);

// Round numbers that divide a range into about `count` parts.
export function ticks(low, high, count = 5) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const steps = [0.5, 1, 2, 5, 10].map((f) => f * power);
  const within = (step) => Math.floor(high / step + 1e-9) - Math.ceil(low / step - 1e-9) + 1;
  // The first that is wide enough, or the one before where that leaves a single number.
  const at = steps.findIndex((step) => step >= rough * (1 - 1e-9)), step = within(steps[at]) < 3 ? steps[at - 1] : steps[at];
  const result = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) result.push(k * step);
  return { at: result, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}
