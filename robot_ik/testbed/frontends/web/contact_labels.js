// The depths of contacts, written at the contacts in the 3D view.

import { make, show } from "./dom.js";
import { placeAtNode } from "./labels.js";

const MAX_CONTACTS = 8; // the session shows no more

export class ContactLabels {
  constructor() {
    this.count = 0;
    this.labels = Array.from({ length: MAX_CONTACTS }, (_, k) =>
      // The deepest contact is the first, and lies over the others.
      make("div", { class: "rk-label rk-contact rk-hidden", style: `z-index:${-k}` }),
    );
    this.element = make("div", { class: "rk-labels" }, this.labels);
    const step = () => {
      this.place();
      requestAnimationFrame(step);
    };
    step();
  }

  show(view) {
    this.count = Math.min(view.contacts.length, MAX_CONTACTS);
    view.contacts.slice(0, MAX_CONTACTS).forEach(({ depth_mm: depth }, k) => {
      const text = `${depth.toFixed(1)} mm`;
      if (this.labels[k].textContent !== text) this.labels[k].textContent = text;
    });
  }

  place() {
    this.labels.forEach((label, k) => {
      if (k < this.count) placeAtNode(label, `/contacts/${k}`, this.element);
      else show(label, false);
    });
  }
}
