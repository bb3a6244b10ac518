// The interactive donut of "The idea in pictures": one state column, one action column.
//
// The first half is mathematics and nothing else, offered as `misstepDonut` and held against
// misstep's own numbers in tests/test_docs.py. The second half draws it into every element with the
// attribute `data-donut`. No library; it works from a file, too.
"use strict";

(() => {
  // ---------------------------------------------------------------------------- mathematics

  const gaussian = (x, mean, variance) =>
    Math.exp((-0.5 * (x - mean) ** 2) / variance) / Math.sqrt(2 * Math.PI * variance);

  /** Weights h_k, means m_k and variances S_k of the action at a state: Gaussian mixture regression. */
  function conditional(mixture, state) {
    const parts = mixture.map(({ weight, mean: [x, a], covariance: [[xx, xa], [, aa]] }) => ({
      log: Math.log(weight) - 0.5 * Math.log(xx) - (0.5 * (state - x) ** 2) / xx,
      mean: a + (xa / xx) * (state - x),
      variance: aa - (xa * xa) / xx,
    }));
    const largest = Math.max(...parts.map((p) => p.log));
    const total = parts.reduce((sum, p) => sum + Math.exp(p.log - largest), 0);
    return parts.map((p) => ({
      weight: Math.exp(p.log - largest) / total,
      mean: p.mean,
      variance: p.variance,
    }));
  }

  /** Mean and variance of all components together. */
  function moments(components) {
    const mean = components.reduce((sum, c) => sum + c.weight * c.mean, 0);
    const variance = components.reduce(
      (sum, c) => sum + c.weight * (c.variance + (c.mean - mean) ** 2),
      0,
    );
    return { mean, variance };
  }

  /** ε = 1 − 1/(1 + V/s²): how much to explore where actions vary by V. */
  const exploration = (variance, scale) => 1 - 1 / (1 + variance / scale ** 2);

  /** γ, r_α, r_β of the family at ε in one dimension, and the ridge's distance in deviations. */
  function donutShape(epsilon, k, reach) {
    const gamma = 1 + epsilon / (k - 1);
    const inner = 1 / (1 + (reach - 1) * epsilon);
    const outer = k * inner;
    const steepness = ((gamma - 1) / gamma) * k ** 3;
    const ridge =
      steepness > 1 ? Math.sqrt((2 * Math.log(steepness)) / (outer ** 2 - inner ** 2)) : 0;
    return { gamma, alpha: inner, beta: outer, ridge };
  }

  /** Density of the donut mixture: Σ h_k (γ N(a; m_k, S_k/r_α²) − (γ − 1) N(a; m_k, S_k/r_β²)). */
  function density(components, shape, a) {
    return components.reduce(
      (sum, c) =>
        sum +
        c.weight *
          (shape.gamma * gaussian(a, c.mean, c.variance / shape.alpha ** 2) -
            (shape.gamma - 1) * gaussian(a, c.mean, c.variance / shape.beta ** 2)),
      0,
    );
  }

  function slope(components, shape, a) {
    const part = (c, r) =>
      ((c.mean - a) / (c.variance / r ** 2)) * gaussian(a, c.mean, c.variance / r ** 2);
    return components.reduce(
      (sum, c) =>
        sum + c.weight * (shape.gamma * part(c, shape.alpha) - (shape.gamma - 1) * part(c, shape.beta)),
      0,
    );
  }

  /** Every mode of the donut mixture, the highest first. */
  function modes(components, shape) {
    const width = (c) => Math.sqrt(c.variance) / shape.alpha;
    const low = Math.min(...components.map((c) => c.mean - 3 * width(c)));
    const high = Math.max(...components.map((c) => c.mean + 3 * width(c)));
    const step = Math.min(...components.map((c) => Math.sqrt(c.variance) / shape.beta)) / 8;
    const found = [];
    for (let a = low; a < high; a += step) {
      if (!(slope(components, shape, a) > 0 && slope(components, shape, a + step) <= 0)) continue;
      let [left, right] = [a, a + step];
      for (let i = 0; i < 60; i += 1) {
        const middle = 0.5 * (left + right);
        if (slope(components, shape, middle) > 0) left = middle;
        else right = middle;
      }
      found.push(0.5 * (left + right));
    }
    const height = (a) => density(components, shape, a);
    return found.sort((a, b) => height(b) - height(a));
  }

  // Two demonstrators who push with the lean and against it; one; and a mixture that misstep fitted
  // to the made-up data of the paper's section V-A (seed 0). Angles in degrees, forces in newtons.
  const line = (weight, gain, deviation, noise) => ({
    weight,
    mean: [0, 0],
    covariance: [
      [deviation ** 2, gain * deviation ** 2],
      [gain * deviation ** 2, gain ** 2 * deviation ** 2 + noise ** 2],
    ],
  });
  const DATA = [
    {
      name: "two who disagree",
      scale: 7,
      mixture: [line(0.55, 0.1, 70, 2.5), line(0.45, -0.1, 70, 2.5)],
    },
    { name: "one demonstrator", scale: 7, mixture: [line(1, 0.1, 70, 4)] },
    {
      name: "the paper's made-up data",
      scale: 10,
      mixture: [
        { weight: 0.346886, mean: [115.374, -0.417905], covariance: [[1583.59, 65.4695], [65.4695, 195.468]] },
        { weight: 0.0858075, mean: [-62.2779, 5.72301], covariance: [[565.261, -53.9582], [-53.9582, 19.6189]] },
        { weight: 0.308843, mean: [-2.11035, -0.672099], covariance: [[1926.89, 93.5099], [93.5099, 12.7739]] },
        { weight: 0.258464, mean: [-131.646, -0.0759548], covariance: [[914.443, -20.6358], [-20.6358, 298.181]] },
      ],
    },
  ];
  const K = 2;

  globalThis.misstepDonut = {
    conditional, moments, exploration, donutShape, density, modes, DATA, K,
  };

  // -------------------------------------------------------------------------------- drawing

  const SVG = "http://www.w3.org/2000/svg";
  const [WIDTH, HEIGHT] = [400, 290];
  const AREA = { left: 46, right: 390, top: 14, bottom: 246 };
  const ANGLES = [-180, 180];
  const FORCES = [-30, 30];
  const FAMILY = [0, 0.25, 0.5, 0.75, 1];

  const scaleTo = ([low, high], from, to) => (value) =>
    from + ((value - low) / (high - low)) * (to - from);
  const horizontal = (range) => scaleTo(range, AREA.left, AREA.right);
  const vertical = (range) => scaleTo(range, AREA.bottom, AREA.top);
  const signed = (value, digits = 1) => value.toFixed(digits).replace(/^-(?=0\.?0*$)/, "").replace("-", "−");

  function add(parent, name, attributes = {}, text = "") {
    const made = parent.namespaceURI === SVG || name === "svg"
      ? document.createElementNS(SVG, name)
      : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text) made.textContent = text;
    parent.append(made);
    return made;
  }

  /** Axes with ticks; returns the group that is drawn anew each time. */
  function frame(parent, title, xs, ys, xTitle, yTitle) {
    const figure = add(parent, "figure");
    add(figure, "figcaption", {}, title);
    const svg = add(figure, "svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, "aria-hidden": "true" });
    const [X, Y] = [horizontal(xs.range), vertical(ys.range)];
    for (const tick of xs.ticks) {
      add(svg, "line", { class: "grid", x1: X(tick), x2: X(tick), y1: AREA.top, y2: AREA.bottom });
      add(svg, "text", { class: "tick", x: X(tick), y: AREA.bottom + 15 }, signed(tick, 0));
    }
    for (const tick of ys.ticks) {
      add(svg, "line", { class: "grid", x1: AREA.left, x2: AREA.right, y1: Y(tick), y2: Y(tick) });
      add(svg, "text", { class: "tick end", x: AREA.left - 6, y: Y(tick) + 4 }, signed(tick, 0));
    }
    add(svg, "text", { class: "axis", x: (AREA.left + AREA.right) / 2, y: HEIGHT - 10 }, xTitle);
    const middle = (AREA.top + AREA.bottom) / 2;
    add(svg, "text", { class: "axis", transform: `translate(14 ${middle}) rotate(-90)` }, yTitle);
    return { svg, layer: add(svg, "g") };
  }

  /** Samples of a mixture that are the same every time, for looking at. */
  function samples(mixture, count) {
    let seed = 7;
    const uniform = () => {
      seed = (seed * 16807) % 2147483647;
      return seed / 2147483647;
    };
    const normal = () => Math.sqrt(-2 * Math.log(uniform())) * Math.cos(2 * Math.PI * uniform());
    return mixture.flatMap(({ weight, mean: [x, a], covariance: [[xx, xa], [, aa]] }) =>
      Array.from({ length: Math.round(weight * count) }, () => {
        const [u, v] = [normal(), normal()];
        const root = Math.sqrt(xx);
        return [x + root * u, a + (xa / root) * u + Math.sqrt(aa - (xa * xa) / xx) * v];
      }),
    );
  }

  /** The ellipse of two standard deviations, as a path. */
  function ellipse({ mean: [x, a], covariance: [[xx, xa], [, aa]] }, X, Y) {
    const root = Math.sqrt(xx);
    const rest = Math.sqrt(Math.max(aa - (xa * xa) / xx, 0));
    const points = Array.from({ length: 73 }, (_, i) => {
      const [u, v] = [2 * Math.cos((i * Math.PI) / 36), 2 * Math.sin((i * Math.PI) / 36)];
      return `${X(x + root * u).toFixed(1)} ${Y(a + (xa / root) * u + rest * v).toFixed(1)}`;
    });
    return `M${points.join("L")}Z`;
  }

  function slider(parent, label, id, { low, high, step, value }) {
    const row = add(parent, "div", { class: "row" });
    add(row, "label", { for: id }, label);
    const input = add(row, "input", { type: "range", id, min: low, max: high, step });
    input.value = value;
    const output = add(row, "output", { for: id });
    return { input, show: (text) => { output.textContent = text; } };
  }

  function build(root, index) {
    const id = (name) => `donut-${index}-${name}`;
    root.replaceChildren();
    const controls = add(root, "div", { class: "controls" });
    const pictures = add(root, "div", { class: "pictures" });
    const sentence = add(root, "p", { class: "said", role: "status" });

    const chooser = add(controls, "div", { class: "row" });
    add(chooser, "label", { for: id("data") }, "Data");
    const data = add(chooser, "select", { id: id("data") });
    DATA.forEach(({ name }, i) => add(data, "option", { value: i }, name));

    const state = slider(controls, "State θ", id("state"), { low: -150, high: 150, step: 1, value: 60 });
    const epsilon = slider(controls, "Exploration ε", id("epsilon"), { low: 0, high: 1, step: 0.01, value: 0 });
    const reach = slider(controls, "Reach", id("reach"), { low: 1, high: 3, step: 0.1, value: 2 });
    const follow = add(add(controls, "div", { class: "row" }), "label", { class: "tick-box" });
    const follows = add(follow, "input", { type: "checkbox", id: id("follow") });
    follows.checked = true;
    const formula = add(follow, "span");

    const done = frame(
      pictures, "What was done in which state",
      { range: ANGLES, ticks: [-180, -90, 0, 90, 180] },
      { range: FORCES, ticks: [-30, -20, -10, 0, 10, 20, 30] }, "θ [deg]", "force [N]",
    );
    const here = frame(
      pictures, "What to do right here",
      { range: FORCES, ticks: [-30, -20, -10, 0, 10, 20, 30] }, { range: [0, 1], ticks: [] },
      "force [N]", "density",
    );
    const [X, Y, F] = [horizontal(ANGLES), vertical(FORCES), horizontal(FORCES)];

    function draw() {
      const { mixture, scale } = DATA[data.value];
      const at = Number(state.input.value);
      const components = conditional(mixture, at);
      const { variance } = moments(components);
      if (follows.checked) epsilon.input.value = exploration(variance, scale).toFixed(2);
      const e = follows.checked ? exploration(variance, scale) : Number(epsilon.input.value);
      const shapes = FAMILY.map((f) => donutShape(f, K, Number(reach.input.value)));
      const shape = donutShape(e, K, Number(reach.input.value));
      const peaks = modes(components, shape);

      state.show(`${signed(at, 0)}°`);
      epsilon.show(e.toFixed(2));
      reach.show(Number(reach.input.value).toFixed(1));
      formula.textContent = `ε follows the disagreement: 1 − 1/(1 + V/s²), s = ${scale} N`;

      done.layer.replaceChildren();
      for (const [x, a] of samples(mixture, 240)) {
        if (Math.abs(x) > 180 || Math.abs(a) > 30) continue;
        add(done.layer, "circle", { class: "sample", cx: X(x), cy: Y(a), r: 1.6 });
      }
      for (const part of mixture) add(done.layer, "path", { class: "component", d: ellipse(part, X, Y) });
      add(done.layer, "line", { class: "here", x1: X(at), x2: X(at), y1: AREA.top, y2: AREA.bottom });
      peaks.forEach((peak, i) =>
        add(done.layer, "circle", { class: i ? "other" : "chosen", cx: X(at), cy: Y(peak), r: i ? 3.5 : 5.5 }));

      here.layer.replaceChildren();
      const grid = Array.from({ length: 241 }, (_, i) => FORCES[0] + (i / 240) * (FORCES[1] - FORCES[0]));
      const plain = grid.map((a) => density(components, donutShape(0, K, 1), a));
      const heights = grid.map((a) => density(components, shape, a));
      const top = 1.08 * Math.max(...plain, ...heights);
      const H = vertical([0, top]);
      const path = (values) => `M${values.map((v, i) => `${F(grid[i]).toFixed(1)} ${H(v).toFixed(1)}`).join("L")}`;
      add(here.layer, "path", { class: "hill", d: `${path(plain)}L${AREA.right} ${AREA.bottom}L${AREA.left} ${AREA.bottom}Z` });
      for (const other of shapes) {
        add(here.layer, "path", { class: "family", d: path(grid.map((a) => density(components, other, a))) });
      }
      add(here.layer, "path", { class: "ring", d: path(heights) });
      peaks.forEach((peak, i) => {
        const height = H(density(components, shape, peak));
        if (!i) add(here.layer, "line", { class: "choice", x1: F(peak), x2: F(peak), y1: height, y2: AREA.bottom });
        add(here.layer, "circle", { class: i ? "other" : "chosen", cx: F(peak), cy: height, r: i ? 3.5 : 5.5 });
      });

      const many = peaks.length === 1 ? "one mode" : `${peaks.length} modes`;
      sentence.textContent =
        `At ${signed(at, 0)}° the forces spread by ${Math.sqrt(variance).toFixed(1)} N: ε = ${e.toFixed(2)}, ` +
        `${many}, the highest at ${signed(peaks[0])} N.`;
    }

    const drag = (event) => {
      if (!(event.buttons & 1)) return;
      const box = done.svg.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * WIDTH;
      state.input.value = ANGLES[0] + ((x - AREA.left) / (AREA.right - AREA.left)) * (ANGLES[1] - ANGLES[0]);
      draw();
    };
    done.svg.addEventListener("pointerdown", (event) => {
      done.svg.setPointerCapture(event.pointerId);
      drag(event);
    });
    done.svg.addEventListener("pointermove", drag);
    epsilon.input.addEventListener("input", () => { follows.checked = false; });
    for (const control of [data, state.input, epsilon.input, reach.input, follows]) {
      control.addEventListener("input", draw);
    }
    draw();
  }

  if (typeof document !== "undefined") {
    const start = () => document.querySelectorAll("[data-donut]").forEach(build);
    if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", start);
    else start();
  }
})();
