// Wearer, session, trial, recording and parameters.

import { say } from "./say.js";
import { degrees, has, number, t, write } from "./texts.js";

const byId = (id) => document.getElementById(id);
const LENGTHS = ["upper_arm", "forearm", "hand"];
const MOMENTS = ["first_moment", "off_axis", "moment_x", "moment_y", "moment_z"].map((name) => `wearer.${name}`);
const CALIBRATED = [...MOMENTS, "wearer.joint_stiffness"]; // of one person, on one arm
const ROUNDED = 0.0006; // m, of a length in the form

// What withdraws the last wearer's calibration from an arm with the settings `now`, if `values` are another person's.
function withdrawn(values, now) {
  const lengths = now?.["wearer.segment_length"] ?? [];
  const isNear = lengths.every((length, n) => Math.abs(length - values["wearer.segment_length"][n]) < ROUNDED);
  if (isNear && ["wearer.body_mass", "wearer.sex"].every((name) => values[name] === now?.[name])) return {};
  const known = CALIBRATED.filter((name) => now?.[name]?.some((value) => value !== 0));
  return Object.fromEntries(known.map((name) => [name, now[name].map(() => 0)]));
}

export class Sections {
  constructor({ send, sure }, cards) {
    this.send = send;
    this.sure = sure;
    this.cards = cards;
    this.form = byId("wearer");
    this.edited = false;
    this.applied = Promise.resolve(); // the last Apply, when it has ended
    this.workspace = {}; // of the subject, sent with the wearer's data
    this.session = new Session(send, this);
    this.markers = new Markers(send);
    this.form.addEventListener("input", () => (this.edited = true));
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      const values = this.wearer();
      const apply = () => this.apply(values);
      this.applied = this.applied.then(apply, apply); // in turn: every arm ends with the wearer who was given last
    });
    byId("trial-start").addEventListener("click", () => send({ do: "trial", name: byId("trials").value }));
    const kinds = { "trial-stop": "stop_trial", record: "record", "record-stop": "stop_recording", save: "save" };
    for (const [id, kind] of Object.entries(kinds)) byId(id).addEventListener("click", () => send({ do: kind }));
    byId("show").addEventListener("click", () => this.showParameters());
  }

  configure(setup) {
    this.markers.configure(setup.markers ?? []);
    const select = byId("trials");
    if (!select.options.length) for (const name of setup.trials ?? []) select.add(new Option(name, name));
    const settings = Object.values(setup.arms ?? {})[0]?.settings;
    if (!this.edited && settings?.["wearer.segment_length"]) this.fill(settings);
  }

  translate() {
    this.markers.translate();
  }

  fill(settings) {
    const fields = this.form.elements;
    fields.body_mass.value = settings["wearer.body_mass"] || ""; // 0: none
    fields.sex.value = settings["wearer.sex"];
    LENGTHS.forEach((name, n) => (fields[name].value = Math.round(1000 * settings["wearer.segment_length"][n]) / 10));
  }

  wearer() {
    const fields = this.form.elements;
    return {
      "wearer.body_mass": Number(fields.body_mass.value),
      "wearer.sex": fields.sex.value,
      "wearer.segment_length": LENGTHS.map((name) => Number(fields[name].value) / 100),
      ...this.workspace,
    };
  }

  async apply(values) {
    const cards = [...this.cards.values()];
    const acts = () => cards.some((card) => card.isCarried && card.mode === "zero_g");
    if (!(await this.sure(cards, () => (acts() ? [t("wearer"), t("wearer_ask"), t("change")] : null)))) return;
    const lowered = [];
    for (const [arm, card] of this.cards) {
      const support = card.supportFor(...Object.values(values));
      const isLess = !(support >= card.support);
      if (isLess) lowered.push(t("applied_lower", card.armText(), number(100 * support, 1)));
      const all = { ...values, ...withdrawn(values, card.setup?.settings) };
      if (!(await this.send({ do: "set", arm, values: isLess ? { ...all, support } : all }))) return;
    }
    this.edited = false;
    say([t("applied"), ...lowered].join(" "));
  }

  show(state, operates) {
    const running = ["running", "reporting"].includes(state.trial.phase);
    byId("save").disabled = !operates;
    const cards = [...this.cards.values()];
    byId("trial-start").disabled = !operates || running || !cards.every((card) => card.state === "active");
    byId("trial-stop").disabled = !operates || state.trial.phase !== "running";
    byId("record").disabled = !operates || state.recording.on || state.recording.foreign;
    byId("record-stop").disabled = !operates || !state.recording.on || running;
    for (const control of this.form.elements) control.disabled = !operates;
    write(byId("recording-text"), recordingText(state.recording));
    write(byId("saved"), state.saved ? t("saved", state.saved) : "");
    this.showTrial(state.trial);
    const isOff = cards.every((card) => OFF.includes(card.state));
    this.markers.show(state.recording, isOff);
    if (state.session) this.session.show(state, operates, isOff);
  }

  showTrial(trial) {
    const step = trial.steps?.[trial.step];
    write(byId("trial-text"), trialText(trial));
    write(byId("trial-step"), trial.phase === "running" && step ? stepText(step, this.cards.values().next().value) : "");
    const report = byId("trial-report");
    report.hidden = !trial.report;
    if (trial.report) report.href = fileAt("report", trial.report);
  }

  async showParameters() {
    const place = byId("parameters");
    place.textContent = await (await fetch("/parameters")).text();
    place.hidden = false;
  }
}

const FREE = { "limits.lower": -3.15, "limits.upper": 3.15 }; // rad: no edges
const OFF = ["disabled", "fault"];
const fileAt = (kind, name) => `/${kind}/${name.split("/").map(encodeURIComponent).join("/")}`;

// Marks events in the recording: by a button for each usual one, by a digit, or by a text of one's own and the key M.
//
// Every page may. A text can be written only while the motors of all arms are off: otherwise the space bar lets down.
class Markers {
  constructor(send) {
    this.send = send;
    this.form = byId("markers");
    this.presets = [];
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.mark(this.own);
    });
    window.addEventListener("keydown", (event) => this.key(event), true);
  }

  get own() {
    return this.form.elements.marker_text.value;
  }

  // presets: the texts that are recorded; those that the page knows are shown in its language.
  configure(presets) {
    if (presets.join() === this.presets.join()) return;
    this.presets = presets;
    byId("presets").replaceChildren(
      ...presets.map((text) => {
        const button = Object.assign(document.createElement("button"), { disabled: true });
        button.dataset.marker = text;
        button.addEventListener("click", () => this.mark(text));
        return button;
      }),
    );
    this.translate();
  }

  translate() {
    [...byId("presets").children].forEach((button, n) => write(button, `${n + 1} ${markerText(button.dataset.marker)}`));
  }

  key(event) {
    const writes = event.target.matches?.("input, select");
    const isPlain = !(event.ctrlKey || event.metaKey || event.altKey || event.repeat);
    if (!isPlain || writes || byId("marker").disabled) return;
    const preset = this.presets[Number(event.key) - 1];
    if (preset !== undefined) this.mark(preset);
    else if (event.code === "KeyM") this.mark(this.own);
  }

  mark(text) {
    this.send({ do: "marker", text }, t("marker_set", text ? markerText(text) : t("markers")));
  }

  show(recording, isOff) {
    const records = recording.on || recording.foreign;
    for (const button of [byId("marker"), ...byId("presets").children]) button.disabled = !records;
    this.form.elements.marker_text.disabled = !isOff;
    write(byId("markers-hint"), t(records ? "markers_hint" : "markers_off"));
  }
}

const markerText = (text) => (has(`marker.${text}`) ? t(`marker.${text}`) : text);

// The subject and the list of past recordings.
//
// Texts can be written only while the motors of all arms are off: otherwise the space bar lets down.
class Session {
  constructor(send, sections) {
    this.send = send;
    this.sections = sections;
    this.form = byId("session").querySelector("form");
    this.present = ""; // as it was last shown
    this.ended = ""; // the trial and the recording, likewise
    this.form.addEventListener("submit", (event) => this.use(event));
    byId("keep-wearer").addEventListener("click", () => send({ do: "keep_wearer" }));
    byId("past-filter").addEventListener("input", () => this.filter());
    window.addEventListener("keydown", takeSpace, true);
  }

  use(event) {
    event.preventDefault();
    const { subject, protocol, note } = this.form.elements;
    this.send({ do: "session", subject: subject.value, protocol: protocol.value, note: note.value });
  }

  show(state, operates, isOff) {
    const { recording, session, trial } = state;
    for (const control of this.form.elements) control.disabled = !operates || !isOff;
    const [first] = this.sections.cards.values();
    byId("keep-wearer").disabled = !operates || !session.subject || first?.setup?.settings["wearer.body_mass"] === 0;
    byId("past-filter").disabled = !isOff;
    for (const button of byId("past").querySelectorAll("button")) button.disabled = !operates || !isOff;
    const present = JSON.stringify(session);
    if (present !== this.present) this.showPresent(session, this.present === "");
    this.present = present;
    const ended = `${trial.phase} ${trial.report} ${recording.on}`;
    if (ended !== this.ended) this.list();
    this.ended = ended;
    const known = Object.keys(session.wearer).length ? t("session.wearer") : t("session.no_wearer");
    write(byId("session-text"), session.subject ? `${t("session.of", session.subject, session.folder)} ${known}` : t("session.none", session.folder));
  }

  showPresent(session, isFirst) {
    for (const name of ["subject", "protocol", "note"]) this.form.elements[name].value = session[name];
    const wearer = session.wearer;
    if (isFirst && !session.subject) return;
    const joints = [...this.sections.cards.values()][0]?.setup?.max_effort?.length ?? 0;
    this.sections.workspace = Object.fromEntries(Object.entries(FREE).map(([name, free]) => [name, wearer[name] ?? Array(joints).fill(free)]));
    if (!wearer["wearer.segment_length"]) return;
    this.sections.fill(wearer);
    this.sections.edited = true; // until it is applied
  }

  async list() {
    const { subjects, past, programs } = await (await fetch("/sessions")).json();
    byId("subjects").replaceChildren(...subjects.map((code) => new Option(code, code)));
    byId("past").replaceChildren(
      ...past.map((entry) => {
        const row = document.createElement("tr");
        const length = entry.seconds === null ? "" : `${number(entry.seconds, 0)} s`;
        const texts = [entry.when, entry.subject, entry.trial, entry.protocol, length, entry.verdict];
        for (const text of texts) row.insertCell().textContent = text;
        const links = row.insertCell();
        const add = (kind, name, text) => links.append(Object.assign(document.createElement("a"), { href: fileAt(kind, name), target: "_blank", rel: "noopener", textContent: text }), " ");
        if (entry.report) add("report", entry.report, t("past_report"));
        if (entry.folder) add("recording", entry.folder, "MCAP");
        for (const program of entry.folder ? programs : []) {
          const button = Object.assign(document.createElement("button"), { textContent: t("past_program", program), disabled: true });
          button.addEventListener("click", () => this.send({ do: "open", name: entry.folder, program }));
          links.append(button, " ");
        }
        return row;
      }),
    );
    this.filter();
  }

  // Shows the rows that have every word of the filter.
  filter() {
    const words = byId("past-filter").value.toLowerCase().split(/\s+/);
    for (const row of byId("past").rows) row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
  }
}

// A space is written in a text field that is enabled: the motors are off then.
function takeSpace(event) {
  if (event.code === "Space" && event.target.matches?.("#session input:enabled, #markers input:enabled, #past-filter:enabled")) event.stopPropagation();
}

function recordingText(recording) {
  if (recording.foreign) return t("recording.foreign");
  if (recording.problem) return t("recording.problem", recording.problem);
  return recording.on ? t("recording.on", recording.seconds, recording.folder) : t("recording.off");
}

function trialText(trial) {
  if (trial.phase === "running" && trial.step >= 0) return t("trial.running", trial.name, Math.min(trial.step + 1, trial.steps.length), trial.steps.length, Math.round(trial.left ?? 0));
  if (trial.phase === "running") return t("trial.ready", trial.name, Math.round(trial.left ?? 0));
  if (trial.phase === "done" && trial.stopped) return t("trial.stopped", trial.name);
  if (trial.phase === "done" && trial.problem) return t("trial.problem", trial.name, trial.problem);
  return t(`trial.${trial.phase}`, trial.name);
}

// card: of an arm, whose joints a pose names.
function stepText({ action, value }, card) {
  if (action === "load") return value[0] ? t("step.load", number(value[0], 1)) : t("step.unload");
  const angles = value.map(degrees);
  return t(`step.${action}`, action === "move" ? card.poseText(angles) : number(angles[0], 0));
}
