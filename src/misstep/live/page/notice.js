// One sentence at the foot of the page on what went wrong, or what has just been done.

import { byId, h, show } from "misstep/dom.js";
import { asSentence } from "misstep/words.js";

const LONG_ENOUGH = 6000; // ms, to read it

export class Notice {
  // page: {state, link(): Link or null, send, isReplay}
  constructor(page) {
    Object.assign(this, page);
    this.problem = "";
    this.read = ""; // a note that somebody has put away
  }

  tell(text) {
    this.problem = asSentence(text);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => { this.problem = ""; this.show(); }, LONG_ENOUGH);
    this.show();
  }

  show() {
    const { session } = this.state, lost = this.link()?.problem;
    if (!session && !lost) return;
    const watches = Boolean(session && !session.drives && !this.isReplay);
    const note = session?.note && session.note !== this.read ? asSentence(session.note) : "";
    if (!session?.note) this.read = "";
    const text = lost || this.problem || (watches ? "Another tab drives; this one watches." : note);
    const box = byId("notice"), told = `${text} ${watches}`;
    if (box.dataset.told !== told) {
      box.dataset.told = told;
      box.replaceChildren(h("span", {}, text));
      if (watches && !lost) box.append(h("button", { id: "take", onclick: () => this.send({ t: "take" }) }, "Drive here"));
      else if (!lost) box.append(h("button", { className: "icon", "aria-label": "Put this notice away", onclick: () => this.putAway() }, "✕"));
    }
    box.classList.toggle("calm", !lost && !this.problem);
    show(box, Boolean(text));
  }

  putAway() {
    if (!this.problem) this.read = this.state.session.note;
    this.problem = "";
    this.show();
  }
}
