// Covers the page when its program no longer answers, because STOP does nothing then.
//
// The program renews the element [data-beat] once a second (ConnectionPanel in panels.py).  A beat that
// reaches the page shows that the program's loop, its server, the connection and the page all work.
// Missed beats are counted in checks, not in seconds: a browser that is busy for a while checks late.
"use strict";
(() => {
  const CHECK_PERIOD = 500; // ms
  const CHECKS_WITHOUT_BEAT = 7; // until the page is covered: 3.5 s
  let beat = null; // the latest; null before the first
  let text = "";
  let checks = 0; // since the latest beat

  const veil = document.createElement("div");
  veil.id = "connection-lost";
  veil.setAttribute("role", "alert");
  // Clicks pass through: whatever has failed, the veil is no reason for a STOP that does not arrive.
  veil.style.cssText =
    "position:fixed;inset:0;z-index:2147483647;display:none;align-items:center;justify-content:center;" +
    "pointer-events:none;white-space:pre-line;padding:10vmin;text-align:center;background:rgba(127,29,29,.88);color:#fff;" +
    "font:700 clamp(20px,4.5vmin,44px)/1.35 system-ui,sans-serif";
  document.body.append(veil);

  const check = () => {
    const element = document.querySelector("[data-beat]");
    if (element !== null && element.dataset.beat !== beat) {
      beat = element.dataset.beat;
      text = element.dataset.lost;
      checks = 0;
    } else if (beat !== null && !document.hidden) {
      checks += 1;
    }
    const lost = checks >= CHECKS_WITHOUT_BEAT;
    veil.textContent = lost ? text : "";
    veil.style.display = lost ? "flex" : "none";
  };
  // A hidden page is not drawn, so its beats wait until it is seen again.
  document.addEventListener("visibilitychange", () => (checks = 0));
  setInterval(check, CHECK_PERIOD);
})();
