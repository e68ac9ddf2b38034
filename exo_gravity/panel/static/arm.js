// The card of one arm: its state in words, what to do about a fault, its buttons, its support, its joints.

import { degrees, finite, has, number, t, translate, write } from "./texts.js";

const SIGNS = { disabled: "○", checking: "◔", "proving signs": "◑", "ramping in": "◕", active: "●", "letting down": "▼", fault: "✖", silent: "?" };
const STEP_PERIOD = 200; // ms between two steps of the support
const LARGEST_STEP = 2; // % of support at once: a slip on the slider must not throw the arm
const SETTLING = 2000; // ms after the last step until the parameters in force are known again
const CARRIED = ["proving signs", "ramping in", "active"];

export class ArmCard {
  constructor(name, actions) {
    this.name = name;
    this.actions = actions;
    this.setup = null;
    this.limit = null; // the largest support 0..1 within the motors' rated torque
    this.root = document.getElementById("arm").content.cloneNode(true).firstElementChild;
    this.root.dataset.arm = name;
    this.find = (selector) => this.root.querySelector(selector);
    this.find("h2").id = `head-${name}`;
    this.root.setAttribute("aria-labelledby", `head-${name}`);
    this.find(".scroll").setAttribute("aria-labelledby", `head-${name}`);
    this.slider = this.find("input");
    this.slider.disabled = true; // until the support in force is known
    this.timer = null;
    this.stepped = NaN; // %, the last step that was taken
    this.moved = -Infinity; // ms, when its user moved the slider or the last step was sent
    this.find(".enable").addEventListener("click", () => actions.enable(this));
    this.find(".clear").addEventListener("click", () => actions.send({ do: "clear_fault", arm: name }));
    this.find(".resume").addEventListener("click", () => actions.send({ do: "resume", arm: name }));
    this.find(".down").addEventListener("click", () => actions.down(name));
    for (const button of this.root.querySelectorAll("[data-mode]"))
      button.addEventListener("click", () => actions.mode(this, button.dataset.mode));
    this.slider.addEventListener("input", () => this.slide());
    this.translate();
  }

  translate() {
    translate(this.root);
    const arm = this.armText();
    write(this.find("h2"), has(`head.${this.name}`) ? t(`head.${this.name}`) : this.name);
    this.find(".enable").setAttribute("aria-label", t("enable_arm", arm));
    this.find(".clear").setAttribute("aria-label", t("clear_fault_arm", arm));
    this.find(".resume").setAttribute("aria-label", t("resume_arm", arm));
    this.find(".down").setAttribute("aria-label", t("let_down_arm", arm));
    write(this.find(".down"), t("let_down_arm", arm));
  }

  armText() {
    return has(`arm.${this.name}`) ? t(`arm.${this.name}`) : this.name;
  }

  get support() {
    return this.setup?.settings?.support ?? NaN;
  }

  get mode() {
    return this.setup?.settings?.mode ?? "one_g";
  }

  // Limits and settings, which change rarely.
  configure(setup) {
    this.setup = setup;
    this.follow();
    for (const button of this.root.querySelectorAll("[data-mode]"))
      button.setAttribute("aria-pressed", String(button.dataset.mode === this.mode));
    this.showSupport();
  }

  // Shows the support in force, unless its user is about to change it.
  follow() {
    if (this.timer || performance.now() - this.moved < SETTLING) return;
    this.stepped = 100 * this.support;
    if (isFinite(this.stepped)) this.slider.value = this.stepped;
    this.showSupport();
  }

  slide() {
    this.moved = performance.now();
    this.showSupport();
    this.timer ??= setInterval(() => this.step(), STEP_PERIOD);
  }

  // Sends the next step towards the slider's value.
  async step() {
    const left = Number(this.slider.value) - this.stepped;
    if (!(Math.abs(left) > 0.05) || this.slider.disabled || this.isSending) {
      if (!this.isSending) this.stop();
      return;
    }
    this.isSending = true;
    const next = this.stepped + Math.max(-LARGEST_STEP, Math.min(LARGEST_STEP, left));
    const done = await this.actions.send({ do: "set", arm: this.name, values: { support: Math.round(10 * next) / 1000 } });
    this.isSending = false;
    this.moved = performance.now();
    if (done) this.stepped = next;
    else this.stop();
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
  }

  showSupport() {
    const value = Number(this.slider.value);
    const limit = this.limit;
    const now = this.stepped;
    const known = limit !== null;
    const mark = this.find(".mark");
    mark.hidden = !known;
    if (known) mark.style.left = `${100 * limit}%`;
    write(this.find("output"), Math.abs(now - value) > 0.05 ? `${number(value, 1)} % (${t("support_now", number(now, 1))})` : `${number(value, 1)} %`);
    this.slider.setAttribute("aria-valuetext", `${number(value, 1)} %`);
    const parts = [known ? t("support_limit", number(Math.floor(1000 * limit) / 10, 1)) : t("support_unknown")];
    if (known && value / 100 > limit) parts.push(t("support_over"));
    if (this.mode === "one_g") parts.push(t("support_unused"));
    write(this.find(".limit"), parts.join(" "));
  }

  // The state, ten times a second.
  show(state, operates, alive) {
    const bridge = alive ? state.bridge : null;
    const name = bridge ? bridge.state || "disabled" : "silent";
    const badge = this.find(".badge");
    badge.dataset.state = name;
    write(this.find(".sign"), SIGNS[name] ?? "?");
    write(this.find(".state"), has(`state.${name}`) ? t(`state.${name}`) : name);
    const unreached = bridge?.message.includes("may still be powered");
    write(this.find(".sentence"), unreached ? t("unreached") : has(`sentence.${name}`) ? t(`sentence.${name}`) : "");
    this.showRemedy(bridge);
    write(this.find(".detail"), bridge?.message ? t("detail", bridge.message) : "");
    const other = alive ? state.compensator : null;
    write(this.find(".compensator"), other ? (other.level ? t("compensator_detail", other.message) : t("carried", other["mass carried (kg)"])) : t("compensator_silent"));
    this.limit = finite(other?.["largest support"]);
    this.root.classList.toggle("stale", !alive);
    this.find(".enable").disabled = !operates || name !== "disabled";
    this.find(".clear").disabled = !operates || name !== "fault";
    this.find(".resume").hidden = bridge?.resume !== "possible";
    this.find(".resume").disabled = !operates;
    for (const control of [this.slider, ...this.root.querySelectorAll("[data-mode]")]) control.disabled = !operates || !other || !isFinite(this.stepped);
    if (this.setup?.settings) this.follow();
    this.showSupport();
    this.showJoints(alive ? state.joints : null, bridge);
    const rates = bridge ? `${t("rate")}: ${bridge["rate (Hz)"] ?? ""} Hz. ${t("age")}: ${bridge["age of efforts (ms)"] ?? ""} ms.` : "";
    const limits = bridge?.["limits acting"];
    write(this.find(".rates"), limits && limits !== "none" ? `${rates} ${t("limits", limits)}` : rates);
  }

  showRemedy(bridge) {
    const code = bridge?.fault && bridge.fault !== "none" ? bridge.fault : "";
    const box = this.find(".remedy");
    box.hidden = !code;
    if (code) write(box.querySelector("p"), t(has(`fault.${code}`) ? `fault.${code}` : "fault.unknown"));
  }

  showJoints(joints, bridge) {
    const body = this.find("tbody");
    const rows = joints ?? [];
    while (body.rows.length > rows.length) body.deleteRow(-1);
    rows.forEach((joint, n) => {
      const row = body.rows[n] ?? newRow(body);
      const limit = this.setup?.max_effort?.[n];
      const cells = [jointText(this.name, joint.name), `${number(degrees(joint.position), 1)}°`, `${number(joint.effort, 2)} / ${number(limit, 1)} Nm`, `${number(temperature(joint, bridge), 0)} °C`];
      cells.forEach((text, column) => write(row.cells[column], text));
    });
  }

  get isCarried() {
    return CARRIED.includes(this.find(".badge").dataset.state);
  }
}

function newRow(body) {
  const row = body.insertRow();
  const head = document.createElement("th");
  head.scope = "row";
  row.append(head);
  for (let n = 0; n < 3; n++) row.insertCell();
  return row;
}

export const temperature = (joint, bridge) => finite(bridge?.[`${joint.name} temperature (degC)`]);

export function jointText(arm, name) {
  const leaf = name.replace(`${arm}_`, "");
  return has(`joint.${leaf}`) ? t(`joint.${leaf}`) : name;
}
