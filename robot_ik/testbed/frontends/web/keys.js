// Keys of the page, before viser's 3D view gets them.
//
// viser moves its camera with W A S D Q E and the arrows, by a listener of the document. The
// listener here is at the window, in the capture phase, and stops the keys that it uses. C switches
// these keys between the ball and viser's camera.

const SPEED = 0.45; // of the ball while a key is held, metres a second
const STEP_MS = 33; // between two steps of the ball
const LONGEST_MS = 100; // of one step: a busy browser does not jump

/** Directions of the keys that move the ball: right, away, up. */
const MOVES = {
  ArrowRight: [1, 0, 0],
  ArrowLeft: [-1, 0, 0],
  ArrowUp: [0, 1, 0],
  ArrowDown: [0, -1, 0],
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
};
const CAMERA_KEYS = new Set([...Object.keys(MOVES), "KeyA", "KeyD", "KeyQ", "KeyE"]);
const SLIDER_KEYS = /^(Arrow|Page|Home|End)/;

/** Whether an element with the focus uses a key itself. */
function usesKey(event) {
  const element = event.target;
  if (!(element instanceof HTMLElement)) return false;
  if (element.isContentEditable || element.matches("textarea, select")) return true;
  if (element.matches("input:not([type=range], [type=checkbox])")) return true;
  if (!element.matches(":focus-visible")) return false;
  if (element.matches("input[type=range], [role=slider]")) return SLIDER_KEYS.test(event.code);
  return ["Space", "Enter"].includes(event.code);
}

export class Keys {
  /**
   * @param actions Functions by the code of a key.
   * @param nudge Called with a step (right, away, up) in metres.
   * @param isDialogOpen Returns whether a dialog is open.
   */
  constructor(actions, nudge, isDialogOpen) {
    this.actions = actions;
    this.nudge = nudge;
    this.isDialogOpen = isDialogOpen;
    this.held = new Set();
    this.movesCamera = false;
    this.onmode = () => {};
    window.addEventListener("keydown", (event) => this.pressed(event), true);
    window.addEventListener("keyup", (event) => this.held.delete(event.code), true);
    window.addEventListener("blur", () => this.held.clear());
  }

  pressed(event) {
    const { code } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || usesKey(event)) return;
    if (this.isDialogOpen() && code !== "Escape") return;
    if (CAMERA_KEYS.has(code)) {
      if (this.movesCamera) return;
      if (MOVES[code]) this.hold(code);
    } else if (code === "KeyC") {
      if (!event.repeat) this.setCamera(!this.movesCamera);
    } else if (this.actions[code]) {
      if (!event.repeat) this.actions[code]();
    } else {
      return;
    }
    event.stopImmediatePropagation();
    event.preventDefault();
  }

  setCamera(on) {
    this.movesCamera = on;
    this.held.clear();
    this.onmode(on);
  }

  hold(code) {
    const isFirst = this.held.size === 0;
    this.held.add(code);
    if (isFirst) this.move(performance.now() - STEP_MS);
  }

  /** Move the ball while keys are held, in proportion to the time that passed. */
  move(before) {
    if (!this.held.size) return;
    const now = performance.now();
    const distance = (SPEED * Math.min(LONGEST_MS, now - before)) / 1e3;
    const step = [0, 0, 0];
    for (const code of this.held) {
      MOVES[code].forEach((part, k) => {
        step[k] += distance * part;
      });
    }
    this.nudge(step);
    setTimeout(() => this.move(now), STEP_MS);
  }
}

/** Convert a step (right, away, up) relative to the view to the world's axes. */
export function worldStep([right, away, up]) {
  const camera = window.__viserMutable?.camera;
  if (!camera) return [right, away, up];
  const e = camera.matrixWorld.elements; // columns right, up, back; the root turns z up
  const quarter = Math.PI / 2;
  const angle = Math.round(Math.atan2(-e[2], e[0]) / quarter) * quarter;
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return [c * right - s * away, s * right + c * away, up].map((part) => +part.toFixed(6));
}

export const isMove = (code) => code in MOVES;
