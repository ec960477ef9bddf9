// The camera's picture in a corner of the 3D view, with the markers that were detected in it.

import { make, refill, show } from "./dom.js";

const COLUMNS = [
  ["marker", ""],
  ["away, m", "distance from the camera"],
  ["off, px", "reprojection error of its corners"],
];

export class CameraPane {
  constructor(channel) {
    this.image = make("img", { alt: "picture of the camera", width: 320, height: 180 });
    this.image.onload = () => {
      URL.revokeObjectURL(this.image.src);
      channel.send({ shown: this.number });
    };
    this.number = 0;
    this.table = make("table", { class: "rk-table num" });
    this.note = make("p");
    this.element = make(
      "div",
      { class: "rk-pane rk-hidden" },
      this.image,
      make("div", { class: "rk-pane-text" }, this.table, this.note),
    );
  }

  /** Show a picture. The program sends the next one after that. */
  showPicture({ number, jpeg }) {
    this.number = number;
    this.image.src = URL.createObjectURL(jpeg);
  }

  showSettings({ camera }) {
    show(this.element, camera);
  }

  show({ note, markers, error }) {
    this.note.textContent = note;
    this.note.classList.toggle("rk-bad", error);
    refill(this.table, markers, () =>
      markers.length
        ? [
            make("tr", {}, COLUMNS.map(([text, title]) => make("th", { title }, text))),
            ...markers.map(([id, distance, pixels]) =>
              make(
                "tr",
                {},
                [String(id), distance.toFixed(3), pixels.toFixed(2)].map((text) =>
                  make("td", {}, text),
                ),
              ),
            ),
          ]
        : [],
    );
  }
}
