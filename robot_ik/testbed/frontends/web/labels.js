// Names of the instances on the floor, drawn by the page: viser's labels cannot be styled.

import { make, show } from "./dom.js";

/** Put a label where a node is on the screen, or hide it if viser has no such node. */
export function placeAtNode(label, name, frame) {
  const viewer = window.__viserMutable;
  const camera = viewer?.camera;
  const node = name && camera && viewer.nodeRefFromName[name];
  show(label, Boolean(node));
  if (!node) return;
  node.updateWorldMatrix(true, false);
  const at = camera.position.clone().setFromMatrixPosition(node.matrixWorld).project(camera);
  const x = ((at.x + 1) / 2) * frame.clientWidth;
  const y = ((1 - at.y) / 2) * frame.clientHeight;
  label.style.transform = `translate(${x}px, ${y}px) translate(-50%, 4px)`;
}

export class Labels {
  constructor(colours) {
    this.count = 0;
    this.labels = colours.map((colour) =>
      make("div", { class: "rk-label rk-hidden", style: `--c:${colour}` }),
    );
    this.element = make("div", { class: "rk-labels" }, this.labels);
    const step = () => {
      this.place();
      requestAnimationFrame(step);
    };
    step();
  }

  show(view, overlay) {
    const several = view.instances.length > 1;
    this.count = overlay && several ? view.instances.length : 0;
    view.instances.forEach((one, k) => {
      const text = `${k + 1}  ${one.method || "…"}`;
      if (this.labels[k].textContent !== text) this.labels[k].textContent = text;
    });
  }

  /** Put each label where the node of its instance is on the screen. */
  place() {
    this.labels.forEach((label, k) => {
      placeAtNode(label, k < this.count && `/robot/label_${k}`, this.element);
    });
  }
}
