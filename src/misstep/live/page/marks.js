// Marks of the recording that is open: when it went wrong, what became of it, what of it is used.

import { button } from "misstep/actions.js";
import { byId, h, show } from "misstep/dom.js";

export function showMarks(session, id, player, canMark, send) {
  const box = byId("marks");
  show(box, canMark && id !== null);
  if (box.hidden) return;
  const summary = session.attempts.find((attempt) => attempt.id === id);
  const told = JSON.stringify([id, summary?.outcome, summary?.failure_time, summary?.duration]);
  if (box.dataset.told === told) return;
  box.dataset.told = told;
  const mark = (values) => send({ t: "mark", id, outcome: null, failure_time: null, usable: null, ...values });
  const at = () => Math.min(player.position, player.duration);
  box.replaceChildren(
    h("span", { className: "faint" }, "Mark:"),
    button("mark-failed", "it failed here", "", "", () => mark({ failure_time: at() })),
    button("mark-success", "it succeeded", "", "", () => mark({ outcome: "success" })),
    button("mark-unknown", "nobody knows", "", "", () => mark({ outcome: "unknown" })),
    button("cut-before", "cut before here", "", "", () => mark({ usable: [at(), player.duration] })),
    button("cut-after", "cut after here", "", "", () => mark({ usable: [0, at()] })),
    h("span", { className: "faint" }, summary?.failure_time != null ? `failed at ${summary.failure_time.toFixed(2)} s` : summary?.outcome ?? ""));
}
