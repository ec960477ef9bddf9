// Covers the page when the program does not answer, because STOP does nothing then.
//
// Beats come once a second while views arrive. Missed beats are counted in checks, not in seconds:
// a browser that is busy for a while also checks late.

import { make } from "./dom.js";

const CHECK_MS = 500;
const CHECKS_WITHOUT_BEAT = 7; // until the page is covered: 3.5 s
const LOST = "Connection lost: STOP does not work";
const LOST_WITH_ARM = `${LOST}.\nUse robot-ik stop or the power switch.`;

export class Connection {
  constructor() {
    this.withArm = false;
    this.checks = 0;
    this.started = false; // a beat has come
    this.isClosed = false;
    this.title = make("strong");
    this.element = make(
      "div",
      { class: "rk-veil", id: "connection-lost", role: "alert" },
      make("div", {}, this.title, make("span", {}, "Trying again …")),
    );
    // A hidden page gets no frames: it counts again when it is seen.
    document.addEventListener("visibilitychange", () => {
      this.checks = 0;
    });
    setInterval(() => {
      if (this.started && !document.hidden) this.checks += 1;
      this.update();
    }, CHECK_MS);
  }

  beat() {
    this.started = true;
    this.isClosed = false;
    this.checks = 0;
    this.update();
  }

  closed() {
    this.isClosed = true;
    this.update();
  }

  update() {
    const lost = this.started && (this.isClosed || this.checks >= CHECKS_WITHOUT_BEAT);
    this.title.textContent = this.withArm ? LOST_WITH_ARM : LOST;
    this.element.classList.toggle("shown", lost);
  }
}
