// A widget for an option: a switch, a menu, or a slider over the option's whole range with a number.

import { make, menu, toggle } from "./dom.js";

const HAND_MS = 1200; // a control that was just moved does not follow the session
const STEPS = 1000; // of a slider
const WIDE = 10; // a range wider than this many usual ranges is logarithmic
const DECADES = 100; // without a usual range, a range with this ratio of its ends is logarithmic
const SMALLEST = 1e-3; // of the usual end: smallest value above zero of a logarithmic slider
const ZERO = 0.02; // share of a logarithmic slider that means zero, if zero is allowed

/** How positions of a slider become values: linear, logarithmic, or logarithmic above zero. */
export function scaleOf({ lower, upper, usual = [] }) {
  const first = lower ?? usual[0] ?? 0;
  const last = upper ?? usual[1] ?? 1;
  const isWide = usual.length ? last - first > WIDE * (usual[1] - usual[0]) : last > DECADES * (first || 1);
  if (first < 0 || !isWide) {
    return {
      shareOf: (value) => (value - first) / (last - first),
      valueOf: (share) => first + share * (last - first),
    };
  }
  if (first > 0) {
    return {
      shareOf: (value) => Math.log(value / first) / Math.log(last / first),
      valueOf: (share) => first * (last / first) ** share,
    };
  }
  const smallest = SMALLEST * (usual[1] ?? 1);
  const above = (share) => (share - ZERO) / (1 - ZERO);
  return {
    shareOf: (value) => {
      if (value < smallest) return 0;
      return ZERO + ((1 - ZERO) * Math.log(value / smallest)) / Math.log(last / smallest);
    },
    valueOf: (share) => (share < ZERO ? 0 : smallest * (last / smallest) ** above(share)),
  };
}

/**
 * Make the widget of an option.
 * @param option Name, help, unit, choices, lower, upper, usual, whole, switch.
 * @param act Called with a new value.
 * @returns The element, and a function that shows a value.
 */
export function parameter(option, act) {
  const { name, help, unit, choices } = option;
  const text = option.label ?? name.replaceAll("_", " ");
  const range = option.lower == null ? "" : `; ${option.lower} to ${option.upper}`;
  const title = `${help}${unit ? ` (${unit})` : ""}${range}`;
  let touched = 0;
  const changed = (value) => {
    touched = Date.now();
    act(value);
  };
  const follow = (set) => (value) => {
    if (Date.now() - touched > HAND_MS) set(value);
  };
  if (option.switch) {
    const box = toggle(text, false, changed, title);
    return { element: box.element, show: follow(box.set) };
  }
  const label = make("label", { title }, text);
  if (choices?.length) {
    const list = menu(choices.map((choice) => [choice, choice]), changed, { label: text });
    const element = make("div", { class: "rk-param" }, label, make("span"), list.element);
    return { element, show: follow(list.set) };
  }
  return numberParameter(option, label, text, changed, follow);
}

function numberParameter(option, label, text, changed, follow) {
  const { lower, upper, whole } = option;
  const { shareOf, valueOf } = scaleOf(option);
  const allowed = (value) => {
    const inside = Math.min(upper ?? Infinity, Math.max(lower ?? -Infinity, value));
    return whole ? Math.round(inside) : inside;
  };
  const textOf = (value) => (whole ? String(Math.round(value)) : String(+(+value).toPrecision(4)));

  const number = make("input", {
    class: "rk-num num",
    inputmode: "decimal",
    "aria-label": `${text} as a number`,
    onchange: () => {
      const value = Number(number.value);
      if (Number.isFinite(value)) changed(allowed(value));
      number.blur();
    },
  });
  const slider = make("input", {
    type: "range",
    class: "rk-range",
    min: 0,
    max: STEPS,
    "aria-label": text,
  });
  const fill = () => slider.style.setProperty("--p", `${(100 * slider.value) / STEPS}%`);
  slider.addEventListener("input", () => {
    const value = allowed(+valueOf(slider.value / STEPS).toPrecision(3));
    number.value = textOf(value);
    fill();
    changed(value);
  });
  const set = (value) => {
    if (document.activeElement !== number) number.value = textOf(value);
    slider.value = STEPS * Math.max(0, Math.min(1, shareOf(value)));
    fill();
  };
  const element = make("div", { class: "rk-param" }, label, slider, number);
  return { element, show: follow(set) };
}
