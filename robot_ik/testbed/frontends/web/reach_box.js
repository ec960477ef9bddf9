// Where the tool can be: the space it reaches, or a reachability map with its scale of colours.

import { heading, make, segmented, show } from "./dom.js";

const PICTURES = [
  ["none", "None", "Show nothing"],
  ["space", "Space", "Surface of the space that the tool reaches"],
  ["cloud", "Cloud", "Reachability map: a point for each cell, coloured by the index"],
  ["shell", "Shell", "Reachability map: its surface, cut open, coloured by the index"],
];

export class ReachBox {
  constructor(channel) {
    const choose = (picture) => channel.action("show_reach", { picture });
    this.pictures = segmented(PICTURES, choose, { label: "reach" });
    this.smallest = make("span");
    this.largest = make("span");
    this.scale = make(
      "div",
      { class: "rk-scale num", title: "Share of the directions in which the tool can come" },
      this.smallest,
      make("i"),
      this.largest,
    );
    this.text = make("p", { class: "rk-note" });
    this.element = make(
      "section",
      {},
      heading("Reach", make("small", {}, "of the tool of robot 1")),
      this.pictures.element,
      this.scale,
      this.text,
    );
    this.showReach({ text: "", smallest_index: 0, largest_index: 0 });
  }

  set(picture) {
    this.pictures.set(picture);
  }

  showReach({ text, smallest_index: smallest, largest_index: largest }) {
    show(this.scale, largest > 0);
    show(this.text, text !== "");
    this.smallest.textContent = `${(100 * smallest).toFixed(0)} %`;
    this.largest.textContent = `${(100 * largest).toFixed(0)} % of directions`;
    this.text.textContent = text;
  }
}
