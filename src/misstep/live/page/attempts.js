// The list of attempts: each with its outcome, a small trace, how long it lasted and what it cost.

import { byId, brief, GLYPHS, h, setText } from "misstep/dom.js";

const SVG = "http://www.w3.org/2000/svg";

function trace(values) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 100 26");
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("aria-hidden", "true");
  const most = Math.max(...values.map(Math.abs), 1e-9);
  const line = document.createElementNS(SVG, "line");
  for (const [name, value] of [["x1", 0], ["x2", 100], ["y1", 13], ["y2", 13]]) line.setAttribute(name, value);
  svg.append(line);
  // A leap of an angle from one side of half a turn to the other is no motion.
  let piece = [];
  const close = () => {
    if (piece.length > 1) {
      const polyline = document.createElementNS(SVG, "polyline");
      polyline.setAttribute("points", piece.join(" "));
      svg.append(polyline);
    }
    piece = [];
  };
  values.forEach((value, i) => {
    if (i && Math.abs(value - values[i - 1]) > 4) close();
    piece.push(`${((100 * i) / Math.max(values.length - 1, 1)).toFixed(1)},${(13 - (12 * value) / most).toFixed(1)}`);
  });
  close();
  return svg;
}

export class AttemptList {
  // ask: {replay(id), remove(id), download(id)}
  constructor(ask) {
    this.ask = ask;
    this.before = "";
  }

  show(attempts, system, open, canUndo, replaying) {
    byId("undo").disabled = !canUndo;
    const told = JSON.stringify([attempts, open, system.name]);
    if (told === this.before) return;
    this.before = told;
    const failed = attempts.filter((attempt) => attempt.outcome === "failure").length;
    setText(byId("attempt-count"), attempts.length ? `${attempts.length}, of which ${failed} failed` : "");
    const list = byId("attempts"), focused = document.activeElement?.dataset?.act;
    list.replaceChildren(...attempts.map((attempt, i) => this.row(attempt, i + 1, open, replaying)));
    if (!attempts.length) {
      list.append(h("li", { className: "empty" }, "Nothing yet. Drive until it goes wrong, and keep it: four failures are plenty. Recordings can be dropped in, too."));
    }
    if (focused) list.querySelector(`[data-act="${focused}"]`)?.focus();
    if (attempts.length > (this.count ?? 0)) list.scrollTop = list.scrollHeight;
    this.count = attempts.length;
  }

  row(attempt, number, open, replaying) {
    const mark = attempt.outcome === "success" ? "success-mark" : attempt.outcome;
    const act = (name, glyph, label, run) =>
      h("button", { "aria-label": `${label} attempt ${number}`, title: label, "data-act": `${name}-${attempt.id}`, onclick: run }, glyph);
    return h("li", { className: attempt.id === open ? "open" : "" },
      h("span", { className: "n" }, String(number)),
      h("span", { className: mark, title: attempt.outcome }, GLYPHS[attempt.outcome]),
      trace(attempt.trace),
      h("span", { className: "num" }, `${attempt.duration.toFixed(2)} s`),
      h("span", { className: "num cost", title: "mean cost of a step" }, `cost ${brief(attempt.cost)}`),
      h("span", {},
        act("replay", "▶", "Replay and mark", () => this.ask.replay(attempt.id)),
        replaying ? null : act("download", "↓", "Download", () => this.ask.download(attempt.id)),
        replaying ? null : act("delete", "✕", "Delete", () => this.ask.remove(attempt.id))));
  }
}
