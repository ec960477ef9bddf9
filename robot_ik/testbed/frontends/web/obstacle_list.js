// The obstacles with their sizes and distances, and the parts that touch.

import { button, heading, make, refill, show } from "./dom.js";

const SHAPES = [
  ["box", "Box"],
  ["sphere", "Sphere"],
  ["cylinder", "Cylinder"],
];

/** Numbers of a size that a person sets: its label and its places in the size. */
const LENGTHS = {
  box: [
    ["length along x", [0]],
    ["length along y", [1]],
    ["length along z", [2]],
  ],
  sphere: [["diameter", [0, 1, 2]]],
  cylinder: [
    ["diameter", [0, 1]],
    ["height", [2]],
  ],
};
LENGTHS.mesh = LENGTHS.box;

const LARGEST_FILE = 700_000; // bytes of a mesh file; the channel takes no more

/** Return the Base64 text of a file. */
async function base64Of(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let text = "";
  for (const byte of bytes) text += String.fromCharCode(byte);
  return btoa(text);
}

export class ObstacleList {
  constructor(channel, notice) {
    this.channel = channel;
    this.notice = notice;
    const add = ([shape, label]) =>
      button(shape, label, () => channel.command("add_obstacle", { shape }), {
        title: "Drag it in the 3D view",
      });
    this.file = make("input", {
      type: "file",
      accept: ".stl,.obj,.msh",
      class: "rk-hidden",
      "aria-label": "mesh file",
      onchange: () => this.load(),
    });
    const mesh = button("open", "Mesh", () => this.file.click(), {
      title: "Load the convex hull of an STL, OBJ or MSH file in metres, up to 700 kB",
    });
    this.table = make("table", { class: "rk-table num" });
    this.contacts = make("ul", { class: "rk-contacts" });
    this.element = make(
      "section",
      {},
      heading("Obstacles", make("small", {}, "planned motions go around them")),
      make("div", { class: "rk-buttons" }, SHAPES.map(add), mesh, this.file),
      this.contacts,
      this.table,
    );
  }

  async load() {
    const file = this.file.files[0];
    this.file.value = "";
    if (!file) return;
    if (file.size > LARGEST_FILE) {
      this.notice(`${file.name} is larger than 700 kB: simplify the mesh`);
    } else {
      this.channel.action("load_mesh", { file: file.name, base64: await base64Of(file) });
    }
  }

  show({ obstacles, contacts }) {
    show(this.contacts, contacts.length > 0);
    const lines = contacts.map(
      ({ parts, depth_mm: depth }) => `${parts.join(" touches ")}: ${depth.toFixed(1)} mm deep`,
    );
    refill(this.contacts, lines, () => lines.map((line) => make("li", {}, line)));
    const kept = obstacles.map(({ name, shape, size }) => [name, shape, size]);
    refill(this.table, kept, () => obstacles.flatMap((one, k) => this.rows(one, k)));
    obstacles.forEach(({ distance, part }, k) => {
      const cell = this.table.rows[2 * k].cells[1];
      const touches = distance !== null && distance < 0;
      cell.textContent = "far";
      if (touches) cell.textContent = `touches ${part}, ${(-1e3 * distance).toFixed(1)} mm deep`;
      else if (distance !== null) cell.textContent = `${(100 * distance).toFixed(1)} cm to ${part}`;
      cell.classList.toggle("rk-bad", touches);
    });
  }

  /** The two rows of an obstacle: its distance and its size. */
  rows({ name, shape, size }, index) {
    const remove = button("trash", "", () => this.channel.command("remove_obstacle", { index }), {
      kind: "plain",
      title: `remove ${name}`,
    });
    const inputs = LENGTHS[shape].map(([label, places]) =>
      this.lengthInput(name, label, places, size, index),
    );
    return [
      make(
        "tr",
        {},
        make("td", {}, name),
        make("td"),
        make("td", { class: "rk-narrow" }, remove),
      ),
      make(
        "tr",
        { class: "rk-sizes" },
        make("td", {}, "size, cm"),
        make("td", { colspan: 2 }, make("div", {}, inputs)),
      ),
    ];
  }

  lengthInput(name, label, places, size, index) {
    const input = make("input", {
      class: "rk-num num",
      inputmode: "decimal",
      "aria-label": `${label} of ${name}`,
      title: `${label}, cm`,
      value: (100 * size[places[0]]).toFixed(1),
      onchange: () => {
        const length = Number(input.value) / 100;
        input.blur();
        if (!(length > 0)) {
          this.notice(`the ${label} of ${name} is a number above 0`);
          input.value = (100 * size[places[0]]).toFixed(1);
          return;
        }
        const changed = size.map((old, k) => (places.includes(k) ? length : old));
        this.channel.command("resize_obstacle", { index, size: changed });
      },
    });
    return input;
  }
}
