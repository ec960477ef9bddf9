// Names of the instances on the floor, drawn by the page: viser's labels have one look only.

import { make, show } from "./dom.js";

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
    const viewer = window.__viserMutable;
    const camera = viewer?.camera;
    this.labels.forEach((label, k) => {
      const node = k < this.count && camera && viewer.nodeRefFromName[`/robot/label_${k}`];
      show(label, Boolean(node));
      if (!node) return;
      node.updateWorldMatrix(true, false);
      const at = camera.position.clone().setFromMatrixPosition(node.matrixWorld).project(camera);
      const { clientWidth: width, clientHeight: height } = this.element;
      const x = ((at.x + 1) / 2) * width;
      const y = ((1 - at.y) / 2) * height;
      label.style.transform = `translate(${x}px, ${y}px) translate(-50%, 4px)`;
    });
  }
}
