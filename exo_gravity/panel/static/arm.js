// The card of one arm: its state in words, what to do about a fault, its buttons, its support, its joints.

import { degrees, has, number, t, translate, write } from "./texts.js";

const SIGNS = { disabled: "○", checking: "◔", "proving signs": "◑", "ramping in": "◕", active: "●", "letting down": "▼", fault: "✖", silent: "?" };
const SEND_PERIOD = 200; // ms between two values of a slider that moves
const CARRIED = ["proving signs", "ramping in", "active"];

export class ArmCard {
  constructor(name, actions) {
    this.name = name;
    this.actions = actions;
    this.setup = null;
    this.root = document.getElementById("arm").content.cloneNode(true).firstElementChild;
    this.root.dataset.arm = name;
    this.find = (selector) => this.root.querySelector(selector);
    this.find("h2").id = `head-${name}`;
    this.root.setAttribute("aria-labelledby", `head-${name}`);
    this.find(".scroll").setAttribute("aria-labelledby", `head-${name}`);
    this.slider = this.find("input");
    this.sent = 0;
    this.find(".enable").addEventListener("click", () => actions.enable(this));
    this.find(".clear").addEventListener("click", () => actions.send({ do: "clear_fault", arm: name }));
    this.find(".down").addEventListener("click", () => actions.down(name));
    for (const button of this.root.querySelectorAll("[data-mode]"))
      button.addEventListener("click", () => actions.mode(this, button.dataset.mode));
    this.slider.addEventListener("input", () => this.slide());
    this.slider.addEventListener("change", () => this.send());
    this.translate();
  }

  translate() {
    translate(this.root);
    const arm = this.armText();
    write(this.find("h2"), has(`head.${this.name}`) ? t(`head.${this.name}`) : this.name);
    this.find(".enable").setAttribute("aria-label", t("enable_arm", arm));
    this.find(".clear").setAttribute("aria-label", t("clear_fault_arm", arm));
    this.find(".down").setAttribute("aria-label", t("let_down_arm", arm));
    write(this.find(".down"), t("let_down_arm", arm));
  }

  armText() {
    return has(`arm.${this.name}`) ? t(`arm.${this.name}`) : this.name;
  }

  get support() {
    return this.setup?.settings?.support ?? 0;
  }

  get mode() {
    return this.setup?.settings?.mode ?? "one_g";
  }

  // Limits and settings, which change rarely.
  configure(setup) {
    this.setup = setup;
    if (performance.now() - this.sent > 1000) this.slider.value = 100 * this.support;
    for (const button of this.root.querySelectorAll("[data-mode]"))
      button.setAttribute("aria-pressed", String(button.dataset.mode === this.mode));
    this.showSupport();
  }

  slide() {
    this.showSupport();
    clearTimeout(this.timer);
    const wait = SEND_PERIOD - (performance.now() - this.sent);
    if (wait <= 0) this.send();
    else this.timer = setTimeout(() => this.send(), wait);
  }

  send() {
    clearTimeout(this.timer);
    const support = Number(this.slider.value) / 100;
    if (performance.now() - this.sent < 1000 && support === this.lastSent) return;
    this.sent = performance.now();
    this.lastSent = support;
    this.actions.send({ do: "set", arm: this.name, values: { support } });
  }

  showSupport() {
    const value = Number(this.slider.value);
    const limit = this.setup?.support_limit;
    const known = limit !== null && limit !== undefined;
    const mark = this.find(".mark");
    mark.hidden = !known;
    if (known) mark.style.left = `${100 * limit}%`;
    write(this.find("output"), `${number(value, 1)} %`);
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
    write(this.find(".compensator"), other ? (other.level ? t("compensator_detail", other.message) : t("carried", other["mass carried"])) : t("compensator_silent"));
    this.root.classList.toggle("stale", !alive);
    this.find(".enable").disabled = !operates || name !== "disabled";
    this.find(".clear").disabled = !operates || name !== "fault";
    for (const control of [this.slider, ...this.root.querySelectorAll("[data-mode]")]) control.disabled = !operates || !other;
    this.showJoints(alive ? state.joints : null);
    const rates = bridge ? `${t("rate")}: ${bridge.rate} Hz. ${t("age")}: ${bridge.answered} ms.` : "";
    write(this.find(".rates"), bridge?.limits && bridge.limits !== "none" ? `${rates} ${t("limits", bridge.limits)}` : rates);
  }

  showRemedy(bridge) {
    const code = bridge?.fault && bridge.fault !== "none" ? bridge.fault : "";
    const box = this.find(".remedy");
    box.hidden = !code;
    if (code) write(box.querySelector("p"), t(has(`fault.${code}`) ? `fault.${code}` : "fault.unknown"));
  }

  showJoints(joints) {
    const body = this.find("tbody");
    const rows = joints ?? [];
    while (body.rows.length > rows.length) body.deleteRow(-1);
    rows.forEach((joint, n) => {
      const row = body.rows[n] ?? newRow(body);
      const limit = this.setup?.max_effort?.[n];
      const cells = [jointText(this.name, joint.name), `${number(degrees(joint.position), 1)}°`, `${number(joint.effort, 2)} / ${number(limit, 1)} Nm`, `${number(joint.temperature, 0)} °C`];
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

export function jointText(arm, name) {
  const leaf = name.replace(`${arm}_`, "");
  return has(`joint.${leaf}`) ? t(`joint.${leaf}`) : name;
}
