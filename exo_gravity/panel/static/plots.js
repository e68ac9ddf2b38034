// The last 30 seconds of each arm: angles, torques with their limits, temperatures, rate and age. uPlot draws.

import { jointText, temperature } from "./arm.js";
import { Painter } from "./painter.js";
import { degrees, finite, t } from "./texts.js";

const LENGTH = 300; // states, ten a second
const COLOURS = ["#0a4f9e", "#a61218", "#0b6b2e", "#7a4b00"];
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]]; // so that colour is not all
const KINDS = [
  ["angle", "°", (joint) => degrees(joint.position)],
  ["torque", "Nm", (joint) => joint.effort],
  ["temperature", "°C", temperature],
];

export class Plots {
  constructor(place) {
    this.place = place;
    this.arms = new Map(); // name -> {times, figures}
    this.limits = {};
    this.width = 0;
    this.painter = new Painter(() => this.draw());
    this.visible = new IntersectionObserver((entries) => {
      for (const entry of entries) entry.target.dataset.visible = entry.isIntersecting ? "yes" : "";
    });
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(place);
  }

  configure(setups) {
    this.limits = Object.fromEntries(Object.entries(setups).map(([name, setup]) => [name, setup.max_effort ?? []]));
  }

  add(arms) {
    for (const [name, arm] of Object.entries(arms)) {
      if (!arm.joints) continue;
      if (!this.arms.has(name)) this.create(name, arm.joints);
      const { figures } = this.arms.get(name);
      const now = performance.now() / 1000;
      const rows = KINDS.map(([, , value]) => arm.joints.map((joint) => value(joint, arm.bridge)));
      rows.push([finite(arm.bridge?.["rate (Hz)"]), finite(arm.bridge?.["age of efforts (ms)"])]);
      figures.forEach((figure, n) => push(figure, now, rows[n]));
    }
    this.painter.request();
  }

  draw() {
    for (const { figures } of this.arms.values())
      for (const { plot, data, element } of figures) if (element.dataset.visible) plot.setData(data);
  }

  create(name, joints) {
    const labels = joints.map((joint) => joint.name);
    const limits = this.limits[name] ?? [];
    const figures = KINDS.map(([kind, unit]) => this.figure(name, kind, unit, labels, kind === "torque" ? limits : []));
    figures.push(this.figure(name, "rate", "Hz, ms", ["rate", "age"], []));
    this.arms.set(name, { figures });
  }

  figure(arm, kind, unit, names, limits) {
    const element = document.createElement("figure");
    const caption = document.createElement("figcaption");
    const canvas = document.createElement("div");
    element.append(caption, canvas);
    this.place.append(element);
    this.visible.observe(element);
    const series = names.map((_, n) => ({ stroke: COLOURS[n], dash: DASHES[n], width: 2 }));
    const options = {
      width: Math.max(200, element.clientWidth),
      height: 160,
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false } },
      axes: [{ values: (plot, splits) => splits.map((s) => `${Math.round(s - plot.scales.x.max)} s`) }, { size: 50 }],
      series: [{}, ...series],
      hooks: { draw: [(plot) => drawLimits(plot, limits)] },
    };
    const data = [[], ...names.map(() => [])];
    const figure = { arm, kind, unit, names, element, caption, plot: new uPlot(options, data, canvas), data };
    caption.textContent = title(figure);
    return figure;
  }

  translate() {
    for (const { figures } of this.arms.values()) for (const figure of figures) figure.caption.textContent = title(figure);
  }

  resize() {
    if (this.place.clientWidth === this.width) return; // only the height has changed, by the plots themselves
    this.width = this.place.clientWidth;
    for (const { figures } of this.arms.values())
      for (const { plot, element } of figures) plot.setSize({ width: Math.max(200, element.clientWidth), height: 160 });
  }
}

const MARKS = ["——", "– –", "····", "–·–"];

function title({ arm, kind, unit, names }) {
  const words = kind === "rate" ? [`${t("rate")} (Hz)`, `${t("age")} (ms)`] : names.map((name) => jointText(arm, name));
  const head = kind === "rate" ? `${t("rate")}, ${t("age")}` : `${t(kind)} (${unit})`;
  return `${t(`head.${arm}`)}: ${head}: ${words.map((word, n) => `${MARKS[n]} ${word}`).join(", ")}`;
}

function push(figure, now, values) {
  const { data } = figure;
  data[0].push(now);
  values.forEach((value, n) => data[n + 1].push(value));
  if (data[0].length > LENGTH) for (const column of data) column.shift();
}

// Each joint's torque limit, a thin line in its colour.
function drawLimits(plot, limits) {
  const { ctx, bbox } = plot;
  limits.forEach((limit, n) => {
    for (const value of [limit, -limit]) {
      const y = plot.valToPos(value, "y", true);
      if (!(y >= bbox.top && y <= bbox.top + bbox.height)) continue;
      ctx.strokeStyle = COLOURS[n];
      ctx.lineWidth = 1;
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
  });
}
