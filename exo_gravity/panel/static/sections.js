// Wearer, trial, recording and parameters.

import { ask } from "./ask.js";
import { degrees, number, t, write } from "./texts.js";

const byId = (id) => document.getElementById(id);
const LENGTHS = ["upper_arm", "forearm", "hand"];

export class Sections {
  constructor(send, cards) {
    this.send = send;
    this.cards = cards;
    this.form = byId("wearer");
    this.edited = false;
    this.form.addEventListener("input", () => (this.edited = true));
    this.form.addEventListener("submit", (event) => this.apply(event));
    byId("trial-start").addEventListener("click", () => send({ do: "trial", name: byId("trials").value }));
    byId("trial-stop").addEventListener("click", () => send({ do: "stop_trial" }));
    byId("record").addEventListener("click", () => send({ do: "record" }));
    byId("record-stop").addEventListener("click", () => send({ do: "stop_recording" }));
    byId("save").addEventListener("click", () => send({ do: "save" }));
    byId("show").addEventListener("click", () => this.showParameters());
  }

  configure(setup) {
    const select = byId("trials");
    if (!select.options.length) for (const name of setup.trials ?? []) select.add(new Option(name, name));
    const settings = Object.values(setup.arms ?? {})[0]?.settings;
    const lengths = settings?.["wearer.segment_length"];
    if (this.edited || !lengths) return;
    const fields = this.form.elements;
    fields.body_mass.value = settings["wearer.body_mass"];
    fields.sex.value = settings["wearer.sex"];
    LENGTHS.forEach((name, n) => (fields[name].value = Math.round(1000 * lengths[n]) / 10));
  }

  async apply(event) {
    event.preventDefault();
    const fields = this.form.elements;
    const values = {
      "wearer.body_mass": Number(fields.body_mass.value),
      "wearer.sex": fields.sex.value,
      "wearer.segment_length": LENGTHS.map((name) => Number(fields[name].value) / 100),
    };
    const acts = [...this.cards.values()].some((card) => card.isCarried && card.mode === "zero_g");
    if (acts && !(await ask(t("wearer"), t("wearer_ask"), t("change")))) return;
    const lowered = [];
    for (const [arm, card] of this.cards) {
      const support = card.supportFor(...Object.values(values));
      const isLess = !(support >= card.support);
      if (isLess) lowered.push(t("applied_lower", card.armText(), number(100 * support, 1)));
      if (!(await this.send({ do: "set", arm, values: isLess ? { ...values, support } : values }))) return;
    }
    this.edited = false;
    write(byId("message"), [t("applied"), ...lowered].join(" "));
  }

  show(state, operates) {
    const running = ["running", "reporting"].includes(state.trial.phase);
    for (const id of ["save"]) byId(id).disabled = !operates;
    byId("trial-start").disabled = !operates || running;
    byId("trial-stop").disabled = !operates || state.trial.phase !== "running";
    byId("record").disabled = !operates || state.recording.on || state.recording.foreign;
    byId("record-stop").disabled = !operates || !state.recording.on || running;
    for (const control of this.form.elements) control.disabled = !operates;
    write(byId("recording-text"), recordingText(state.recording));
    write(byId("saved"), state.saved ? t("saved", state.saved) : "");
    this.showTrial(state.trial);
  }

  showTrial(trial) {
    const step = trial.steps?.[trial.step];
    write(byId("trial-text"), trialText(trial));
    write(byId("trial-step"), trial.phase === "running" && step ? stepText(step) : "");
    const report = byId("trial-report");
    report.hidden = !trial.report;
    if (trial.report) report.href = `/report/${encodeURIComponent(trial.report)}`;
  }

  async showParameters() {
    const place = byId("parameters");
    const content = await (await fetch("/parameters")).json();
    place.textContent = Object.entries(content)
      .map(([node, values]) => `${node}\n${Object.entries(values).map(([name, value]) => `  ${name}: ${JSON.stringify(value)}`).join("\n")}`)
      .join("\n\n");
    place.hidden = false;
  }
}

function recordingText(recording) {
  if (recording.foreign) return t("recording.foreign");
  return recording.on ? t("recording.on", recording.seconds, recording.folder) : t("recording.off");
}

function trialText(trial) {
  if (trial.phase === "running" && trial.step >= 0) return t("trial.running", trial.name, Math.min(trial.step + 1, trial.steps.length), trial.steps.length, Math.round(trial.left ?? 0));
  if (trial.phase === "running") return t("trial.ready", trial.name, Math.round(trial.left ?? 0));
  if (trial.phase === "done" && trial.problem) return t("trial.problem", trial.name, trial.problem);
  return t(`trial.${trial.phase}`, trial.name);
}

function stepText(step) {
  return t(`step.${step.action}`, step.value.map((angle) => number(degrees(angle), 0)).join("° "));
}
