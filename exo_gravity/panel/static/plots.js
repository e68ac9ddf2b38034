// The last 30 seconds of each arm: angles, torques with their limits, temperatures, rate and age. uPlot draws.
//
// A figure without a curve says why. An arm that falls silent leaves a gap, so that no old curve looks like a new one.

import { temperature } from "./arm.js";
import { colour } from "./colours.js";
import { Painter } from "./painter.js";
import { headText, jointText } from "./telling.js";
import { degrees, finite, t, write } from "./texts.js";

const LENGTH = 300; // states, ten a second
const BESIDE = ["angle", "torque"]; // the kinds beside the state; the others are folded
const AGES = [30, 20, 10, 0]; // s, which the time axis names
const COLOURS = ["--curve-1", "--curve-2", "--curve-3", "--curve-4"]; // of panel.css
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]]; // so that colour is not all
const MARKS = ["——", "– –", "····", "–·–"];
const KINDS = [
  ["angle", "°", (joint) => degrees(joint.position)],
  ["torque", "Nm", (joint) => joint.effort],
  ["temperature", "°C", temperature],
];
// An arm may have more joints than there are colours: each further round has other dashes, so that no two look alike.
const colourOf = (n) => COLOURS[n % COLOURS.length];
const dashOf = (n) => (n + Math.floor(n / COLOURS.length)) % DASHES.length;

export class Plots {
  // place: of the plots beside the state, with their legend before it. more: of the others.
  constructor(place, more) {
    this.place = place;
    this.more = more;
    this.note = document.getElementById("plots-blank");
    this.arms = new Map(); // name -> {figures}
    this.limits = {};
    this.painter = new Painter(() => this.draw());
    this.visible = new IntersectionObserver((entries) => {
      for (const entry of entries) entry.target.dataset.visible = entry.isIntersecting ? "yes" : "";
    });
    this.observer = new ResizeObserver(() => this.resize());
    for (const each of [place, more]) this.observer.observe(each);
  }

  configure(setups) {
    this.limits = Object.fromEntries(Object.entries(setups).map(([name, setup]) => [name, setup.max_effort ?? []]));
  }

  // arms: the states of all arms.
  add(arms) {
    const now = performance.now() / 1000;
    for (const [name, arm] of Object.entries(arms)) {
      if (arm.joints && !this.arms.has(name)) this.create(name, arm.joints);
      for (const figure of this.arms.get(name)?.figures ?? []) {
        push(figure, now, figure.values(arm));
        write(figure.blank, whyBlank(figure, arm));
      }
    }
    const missing = Object.keys(arms).filter((name) => !this.arms.has(name));
    this.note.hidden = this.arms.size > 0 && !missing.length;
    const waiting = missing.map((name) => `${headText(name)}: ${t("blank.waiting")}`).join(" ");
    write(this.note, this.note.hidden ? "" : waiting || t("blank.no_arm"));
    this.painter.request();
  }

  draw() {
    for (const { figures } of this.arms.values())
      for (const { plot, data, element } of figures) if (element.dataset.visible) plot.setData(data);
  }

  create(name, joints) {
    const labels = joints.map((joint) => joint.name);
    const nothing = joints.map(() => null);
    const figures = KINDS.map(([kind, unit, value]) =>
      this.figure(name, kind, unit, labels, (arm) => arm.joints?.map((joint) => value(joint, arm.bridge)) ?? nothing),
    );
    const rates = (arm) => [finite(arm.bridge?.["rate (Hz)"]), finite(arm.bridge?.["age of efforts (ms)"])];
    figures.push(this.figure(name, "rate", "Hz, ms", ["rate", "age"], rates));
    this.arms.set(name, { figures });
    this.translate();
  }

  // values: returns the newest number of each curve from an arm's state, null where there is none.
  figure(arm, kind, unit, names, values) {
    const element = document.createElement("figure");
    const caption = document.createElement("figcaption");
    const canvas = document.createElement("div");
    const blank = Object.assign(document.createElement("p"), { className: "blank" });
    element.append(caption, canvas, blank);
    (BESIDE.includes(kind) ? this.place : this.more).append(element);
    this.visible.observe(element);
    const axis = { stroke: () => colour("--ink"), grid: { stroke: () => colour("--grid") }, ticks: { stroke: () => colour("--grid") } };
    const options = {
      ...sizeOf(canvas),
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false }, y: { range: (plot, low, high) => rangeOf(low, high, kind === "torque" ? this.limits[arm] : []) } },
      axes: [
        { ...axis, size: 26, splits: agesOf, values: (plot, splits) => splits.map((s) => `${Math.round(s - plot.scales.x.max)} s`) },
        { ...axis, size: 50 },
      ],
      series: [{}, ...names.map((_, n) => ({ stroke: () => colour(colourOf(n)), dash: DASHES[dashOf(n)], width: 2 }))],
      hooks: { draw: [(plot) => kind === "torque" && drawLimits(plot, this.limits[arm] ?? [])] },
    };
    const data = [[], ...names.map(() => [])];
    return { arm, kind, unit, names, values, element, caption, canvas, blank, plot: new uPlot(options, data, canvas), data };
  }

  translate() {
    const known = new Set(); // arms with the same joints have one legend
    const legend = document.getElementById("legend");
    legend.replaceChildren();
    for (const { figures } of this.arms.values())
      for (const figure of figures) {
        const head = document.createElement("div");
        const isBeside = BESIDE.includes(figure.kind);
        write(head, titleOf(figure));
        figure.caption.replaceChildren(head, ...(isBeside ? [] : curvesOf(figure)));
        if (isBeside) legend.append(...curvesOf(figure).filter(({ textContent: text }) => !known.has(text) && known.add(text)));
      }
  }

  resize() {
    for (const { figures } of this.arms.values())
      for (const { plot, canvas } of figures) {
        const size = sizeOf(canvas);
        if (plot.width !== size.width || plot.height !== size.height) plot.setSize(size);
      }
  }
}

const sizeOf = ({ clientWidth, clientHeight }) => ({ width: Math.max(100, clientWidth), height: Math.max(80, clientHeight) });

// The ends of the vertical axis: every limit is in sight. low, high: of the curves, null without one.
function rangeOf(low, high, limits = []) {
  const most = 1.1 * Math.max(0, ...limits);
  if (most) return [Math.min(low, -most), Math.max(high, most)];
  return low === null ? [low, high] : uPlot.rangeNum(low, high, 0.1, true);
}

function titleOf({ arm, kind, unit }) {
  return `${headText(arm)}: ${kind === "rate" ? `${t("rate")}, ${t("age")}` : `${t(kind)} (${unit})`}`;
}

// Each curve's name behind its mark, both in its colour.
function curvesOf({ arm, kind, names }) {
  const words = kind === "rate" ? [`${t("rate")} (Hz)`, `${t("age")} (ms)`] : names.map((name) => jointText(arm, name));
  return words.map((word, n) => {
    const mark = Object.assign(document.createElement("span"), { textContent: `${MARKS[dashOf(n)]} ${word}`, className: "curve" });
    mark.style.color = `var(${colourOf(n)})`;
    return mark;
  });
}

function push({ data }, now, values) {
  data[0].push(now);
  values.forEach((value, n) => data[n + 1].push(value ?? null));
  if (data[0].length > LENGTH) for (const column of data) column.shift();
}

// Where the time axis has its marks: seconds before the newest state, as far back as there are states.
function agesOf(plot, axis, first, newest) {
  return AGES.map((age) => newest - age).filter((mark) => mark >= first);
}

// Why a figure has no curve; '' if it has one.
function whyBlank({ data, kind }, arm) {
  if (data.slice(1).some((column) => column.some((value) => value !== null))) return "";
  if (!arm.joints) return t("blank.silent");
  return t(`blank.${kind === "angle" ? "waiting" : kind}`);
}

// Each joint's torque limit, a thin line in its colour.
function drawLimits(plot, limits) {
  const { ctx, bbox } = plot;
  limits.forEach((limit, n) => {
    for (const value of limit ? [limit, -limit] : []) {
      const y = plot.valToPos(value, "y", true);
      if (!(y >= bbox.top && y <= bbox.top + bbox.height)) continue;
      ctx.strokeStyle = colour(colourOf(n));
      ctx.lineWidth = 1;
      ctx.setLineDash([]);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
  });
}
