// The experiments of the theses: the four cases of S12 with table 4.1, the courses of A00.

import { Dialog } from "./dialogs.js";
import { button, heading, make, refill, show } from "./dom.js";

const CASES = [
  "1: ball on a curve",
  "2: ball at random, a new place in each frame",
  "3: as 1, joints within ±45°",
  "4: as 2, joints within ±45°",
];

/** Mean time in ms, mean iterations, per cent solved, as table 4.1 has them. */
function cellText([milliseconds, iterations, solved]) {
  const time = milliseconds < 1 ? milliseconds.toFixed(3) : milliseconds.toFixed(1);
  return `${time} / ${iterations.toFixed(0)} / ${Math.floor(solved + 1e-6)}`;
}

class CaseTable extends Dialog {
  constructor() {
    super("table 4.1 of thesis S12");
    this.body = make("table", { class: "rk-table num rk-cases" });
    this.box.append(
      make("h2", {}, "Thesis S12, table 4.1: the thesis and this page"),
      make(
        "p",
        { class: "rk-note" },
        "Each cell: mean time of a solve in ms / mean iterations / per cent solved within 5 cm. " +
          "Upper line: the thesis (2012). Lower line: this page, with the parameters of the thesis.",
      ),
      this.body,
      make(
        "p",
        { class: "rk-note" },
        "The thesis does not state its lengths, its curve and its computer. " +
          "CCD counts rotations of single bones, as the thesis does.",
      ),
      make(
        "div",
        { class: "rk-buttons" },
        button("", "Close", () => this.close(), { kind: "primary" }),
      ),
    );
  }

  showCells(cells) {
    refill(this.body, cells, () => {
      const methods = [...new Set(cells.map(({ method }) => method))];
      const head = make(
        "tr",
        {},
        make("th", {}, "method"),
        CASES.map((text) => make("th", {}, text)),
      );
      const row = (method) =>
        make(
          "tr",
          {},
          make("td", {}, method),
          cells.filter((cell) => cell.method === method).map((cell) => this.cell(cell)),
        );
      return [head, ...methods.map(row)];
    });
  }

  cell({ thesis, measured }) {
    return make(
      "td",
      {},
      make("div", { class: "rk-thesis" }, cellText(thesis)),
      make("div", {}, measured ? cellText(measured) : "–"),
    );
  }
}

export class Theses {
  constructor(program, channel) {
    this.table = new CaseTable();
    this.wasRunning = false;
    this.run = button("play", "Run the four cases", () => channel.action("run_cases"), {
      title: "Seven-segment arm, four methods, parameters of the thesis; 1000 frames a case",
    });
    this.open = button("", "Table", () => this.table.open(), { title: "Table 4.1 beside the values of this page" });
    this.progress = make("p", { class: "rk-note", role: "status" });
    this.courses = Object.entries(program.courses).map(([number, result]) =>
      make(
        "button",
        {
          type: "button",
          class: "rk-btn small num",
          "aria-pressed": "false",
          "aria-label": `course ${number}`,
          title: `Test ${number}. Thesis: ${result}`,
          onclick: () => channel.command("set_course", { number: +number }),
        },
        number,
      ),
    );
    this.course = make("div", { class: "rk-course" });
    this.element = make(
      "div",
      {},
      heading("Thesis S12: four cases"),
      make("div", { class: "rk-buttons" }, this.run, this.open),
      this.progress,
      heading("Thesis A00: thirteen courses"),
      make("div", { class: "rk-buttons rk-courses" }, this.courses),
      this.course,
    );
  }

  showCases(cases) {
    this.table.showCells(cases.cells);
    const done = Math.floor(100 * cases.share);
    this.progress.textContent = cases.running
      ? `Case ${cases.case}: ${cases.title}. ${done} % of all frames.`
      : `${done} % of all frames have run.`;
    if (this.wasRunning && !cases.running && cases.share >= 1) this.table.open();
    this.wasRunning = cases.running;
  }

  show({ course, instances }) {
    this.courses.forEach((one, k) => one.setAttribute("aria-pressed", String(course?.number === k + 1)));
    show(this.course, course !== null);
    if (!course) return;
    const { number, moves, thesis, frame, frames, place, met, lost } = course;
    const lines = instances.map(({ method }, k) => {
      const share = `${Math.floor(100 * met[k] + 1e-6)} % met`;
      return `${method}: ${share}${lost[k] ? `, first lost at ${lost[k]}` : ""}`;
    });
    refill(this.course, [number, lines.length], () => {
      this.courseLines = lines.map(() => make("p", { class: "num" }));
      this.courseFrame = make("p", { class: "num" });
      return [
        make("p", {}, `Test ${number}: ${moves}. Thesis: ${thesis}.`),
        this.courseFrame,
        ...this.courseLines,
      ];
    });
    this.courseFrame.textContent = `Frame ${frame} of ${frames}, ${place}`;
    lines.forEach((text, k) => {
      this.courseLines[k].textContent = text;
    });
  }
}
