// The card of one arm: its state in words, what to do about a fault, its buttons, its support, its joints.

import { degrees, finite, has, number, t, translate, write } from "./texts.js";

const SIGNS = { disabled: "○", checking: "◔", "proving signs": "◑", "ramping in": "◕", active: "●", "letting down": "▼", fault: "✖", silent: "?", unseen: "?" };
const PAUSE = 300; // ms without a move of the slider after which its support is asked for
const SETTLING = 2000; // ms after that until the parameters in force are known again
const CARRIED = ["proving signs", "ramping in", "active"];
const STILL = 0.08; // rad/s; slower joints rest
const MEAN = 3; // states over which speed and power are averaged: a velocity is noisy
const RESTED = 1000; // ms at rest after which an arm no longer moves
const OFF = ["disabled", "checking", "fault"]; // the motors are off
const CAUSED = ["over_speed", "torque_not_delivered", "outside_limits", "unexplained_torque"]; // perhaps by a change of load
const STALLED = ["motor_silent", "torque_not_delivered", "wrong_sign", "sign_unproven"]; // perhaps by a computer that stood still
const STALL = 50; // ms; a simulated arm that stands still for longer seems silent

export class ArmCard {
  constructor(name, actions) {
    this.name = name;
    this.actions = actions;
    this.setup = null;
    this.adapts = "off"; // from which support to which
    this.limit = null; // the largest support 0..1 within the motors' rated torque
    this.root = document.getElementById("arm").content.cloneNode(true).firstElementChild;
    this.root.dataset.arm = name;
    this.pose = document.getElementById("pose").content.cloneNode(true).firstElementChild; // stands below the picture
    this.pose.dataset.arm = name;
    this.pose.querySelector("button").addEventListener("click", () => actions.send({ do: "confirm_pose", arm: name }));
    this.find = (selector) => this.root.querySelector(selector);
    this.find("h2").id = `head-${name}`;
    this.root.setAttribute("aria-labelledby", `head-${name}`);
    this.find(".scroll").setAttribute("aria-labelledby", `head-${name}`);
    this.slider = this.find("input");
    this.slider.disabled = true; // until the support in force is known
    this.timer = null;
    this.moved = -Infinity; // ms, when its user moved the slider or the support was sent
    this.speed = this.power = 0; // means of the joints' largest speed in rad/s, and of the motors' power in W
    this.went = -Infinity; // ms, when the arm last moved
    this.find(".enable").addEventListener("click", () => actions.enable(this));
    this.find(".clear").addEventListener("click", () => actions.send({ do: "clear_fault", arm: name }));
    this.find(".resume").addEventListener("click", () => actions.send({ do: "resume", arm: name }));
    this.find(".home").addEventListener("click", () => actions.send({ do: "bring_home", arm: name }));
    this.find(".down").addEventListener("click", () => actions.down(name));
    this.find(".weigh").addEventListener("click", () => actions.weigh(this));
    this.find(".carry").addEventListener("click", () => actions.carry(this, this.weighed));
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
    this.find(".home").setAttribute("aria-label", t("bring_home_arm", arm));
    this.find(".down").setAttribute("aria-label", t("let_down_arm", arm));
    this.find(".weigh").setAttribute("aria-label", t("weigh_arm", arm));
    this.find(".bar").setAttribute("aria-label", t("carries_arm", arm));
    write(this.find(".down"), t("let_down_arm", arm));
    write(this.pose.querySelector("button"), t("confirm_pose", arm));
  }

  armText() {
    return has(`arm.${this.name}`) ? t(`arm.${this.name}`) : this.name;
  }

  get state() {
    return this.find(".badge").dataset.state;
  }

  get moves() {
    return this.find(".badge").hasAttribute("data-moves");
  }

  // State, mode and support in one line.
  summary() {
    const head = this.find("h2").textContent;
    const mode = this.mode === "zero_g" ? `Zero-G, ${number(100 * this.support, 0)} %` : "One-G";
    return `${this.find(".sign").textContent} ${head}: ${this.find(".state").textContent} · ${mode}`;
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
    this.find(".home").hidden = !setup.simulated;
    this.follow();
    for (const button of this.root.querySelectorAll("[data-mode]"))
      button.setAttribute("aria-pressed", String(button.dataset.mode === this.mode));
    this.showSupport();
  }

  // Shows the support in force, unless its user is about to change it.
  follow() {
    if (this.timer || performance.now() - this.moved < SETTLING) return;
    if (isFinite(this.support)) this.slider.value = 100 * this.support;
    this.showSupport();
  }

  slide() {
    this.moved = performance.now();
    this.showSupport();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.request(), PAUSE);
  }

  // Asks for the slider's support; the compensator moves the torque to it only as fast as the arm stays calm.
  async request() {
    const taken = await this.actions.support(this, Math.round(10 * Number(this.slider.value)) / 1000);
    this.timer = null;
    this.moved = taken ? performance.now() : -Infinity;
    this.follow();
  }

  showSupport() {
    const value = Number(this.slider.value);
    const limit = this.limit;
    const now = 100 * this.support;
    const known = limit !== null;
    const mark = this.find(".mark");
    mark.hidden = !known;
    if (known) mark.style.left = `${100 * limit}%`;
    write(this.find("output"), Math.abs(now - value) > 0.05 ? `${number(value, 1)} % (${t("support_now", number(now, 1))})` : `${number(value, 1)} %`);
    this.slider.setAttribute("aria-valuetext", `${number(value, 1)} %`);
    const parts = [known ? t("support_limit", number(Math.floor(1000 * limit) / 10, 1)) : t("support_unknown")];
    if (known && value / 100 > limit) parts.push(t("support_over"));
    if (this.mode === "one_g") parts.push(t("support_unused"));
    if (this.adapts !== "off") parts.push(t("support_adapts", this.adapts));
    write(this.find(".limit"), parts.join(" "));
  }

  // The state, ten times a second.
  show(state, operates, alive) {
    const bridge = alive ? state.bridge : null;
    const name = bridge ? bridge.state || "disabled" : alive ? "silent" : "unseen";
    const badge = this.find(".badge");
    badge.dataset.state = name;
    write(this.find(".sign"), SIGNS[name] ?? "?");
    const moving = name === "active" ? this.motion(state) : "";
    badge.toggleAttribute("data-moves", moving !== "");
    write(this.find(".state"), moving ? t(moving) : has(`state.${name}`) ? t(`state.${name}`) : name);
    const remedy = this.remedy(bridge, state);
    write(this.find(".sentence"), this.sentence(name, moving, state, bridge, remedy));
    this.find(".remedy").hidden = !remedy;
    write(this.find(".remedy p"), remedy);
    write(this.find(".detail"), bridge?.message ? t("detail", bridge.message) : "");
    const other = alive ? state.compensator : null;
    write(this.find(".compensator"), other ? (other.level ? t("compensator_detail", other.message) : t("carried", number(finite(other["mass carried (kg)"]), 2))) : alive ? t("compensator_silent") : "");
    const wearer = alive ? state.wearer : null;
    this.limit = finite(wearer?.["largest support"]);
    this.adapts = wearer?.["support adapts"] ?? "off";
    this.showShare(wearer?.["share of the wearer (%)"]);
    this.showLoad(other, wearer, operates, name === "active");
    this.root.classList.toggle("stale", !alive);
    this.find(".enable").disabled = !operates || name !== "disabled";
    this.find(".clear").disabled = !operates || name !== "fault";
    this.find(".resume").hidden = bridge?.resume !== "possible";
    this.find(".resume").disabled = !operates;
    this.showPose(state.joints, bridge, operates);
    this.find(".home").disabled = !operates || !OFF.includes(name);
    for (const control of [this.slider, ...this.root.querySelectorAll("[data-mode]")]) control.disabled = !operates || !other || !isFinite(this.support);
    if (this.setup?.settings) this.follow();
    this.showSupport();
    this.showJoints(alive ? state.joints : null, bridge);
    const rates = bridge ? `${t("rate")}: ${number(finite(bridge["rate (Hz)"]), 1)} Hz. ${t("age")}: ${number(finite(bridge["age of efforts (ms)"]), 1)} ms.` : "";
    const limits = bridge?.["limits acting"];
    write(this.find(".rates"), limits && limits !== "none" ? `${rates} ${t("limits", limits)}` : rates);
  }

  // Whether the operator is asked if the arm hangs as it is drawn, and at which angles.
  showPose(joints, bridge, operates) {
    const angles = poseAsked(bridge);
    this.pose.hidden = !angles;
    this.pose.querySelector("button").disabled = !operates;
    const shown = (angles ?? []).map((angle, n) => `${jointText(this.name, joints?.[n]?.name ?? "")} ${number(angle, 0)}°`);
    write(this.pose.querySelector("p"), angles ? t("confirm_pose_ask", this.armText(), shown.join(", ")) : "");
  }

  // How much of their arm's weight the wearer carries, to be read from two metres: the bar, and its 95 % band.
  showShare(text) {
    const [value, width] = text?.match(/^(-?\d+) \+- (\d+)$/)?.slice(1).map(Number) ?? [];
    const known = value !== undefined;
    const inside = (percent) => Math.min(100, Math.max(0, percent));
    const bar = this.find(".bar");
    const [low, high] = known ? [inside(value - width), inside(value + width)] : [0, 0];
    write(this.find(".carries strong"), known ? `${number(value, 0)} %` : "–");
    write(this.find(".width"), known ? `± ${number(width, 0)}` : "");
    bar.setAttribute("aria-valuenow", known ? inside(value) : 0);
    bar.setAttribute("aria-valuetext", known ? `${number(value, 0)} %` : t("carries_unknown"));
    this.find(".part").style.width = known ? `${inside(value)}%` : 0;
    this.find(".band").style.left = `${low}%`;
    this.find(".band").style.width = `${high - low}%`;
  }

  // The load in the hand, the result of the last weighing, and the last contact.
  showLoad(compensator, wearer, operates, active) {
    const text = compensator?.weighing ?? "none";
    const found = text.match(/.* \+- ([\d.]+) kg .*payload\.mass = ([\d.]+)/);
    this.weighed = found ? Number(found[2]) : NaN;
    this.find(".weigh").disabled = !operates || !active;
    this.find(".carry").hidden = !found || Math.abs(this.weighed - this.payload) < 0.001;
    this.find(".carry").disabled = !operates;
    write(this.find(".carry"), found ? t("carry_load", number(this.weighed, 2), number(Number(found[1]), 2)) : "");
    write(this.find(".payload"), t("payload_now", number(this.payload, 2)));
    write(this.find(".weighing"), text === "none" ? "" : text);
    const contact = wearer?.contact ?? "none";
    write(this.find(".contact"), contact === "none" ? "" : t("contact", contact));
  }

  get payload() {
    return this.setup?.settings?.["payload.mass"] ?? 0;
  }

  sentence(name, moving, state, bridge, remedy) {
    if (bridge?.message.includes("may still be powered")) return t("unreached");
    if (poseAsked(bridge)) return t("sentence.pose");
    if (moving) return t(changes(state) ? "sentence.changing" : `sentence.${moving}`);
    const outside = ["checking", "disabled"].includes(name) && bridge?.message.match(/(\S+) to be moved by ([-+][\d.]+) degrees/);
    if (outside) return t(`outside.${name}`, jointText(this.name, outside[1]), number(Math.abs(outside[2]), 1));
    const cause = remedy.match(/^.*?[.](?=\s|$)/)?.[0] ?? ""; // what a remedy begins with
    return `${cause} ${has(`sentence.${name}`) ? t(`sentence.${name}`) : ""}`.trim();
  }

  // What the arm does in place of resting; '' while it rests. Gravity moves it where the motors' torque opposes that.
  motion(state) {
    const joints = state.joints ?? [];
    const speed = Math.max(0, ...joints.map((joint) => Math.abs(joint.velocity)));
    const power = joints.reduce((sum, joint) => sum + joint.effort * joint.velocity, 0);
    this.speed += (speed - this.speed) / MEAN;
    this.power += (power - this.power) / MEAN;
    const now = performance.now();
    if (this.speed > STILL) this.went = now;
    if (now - this.went < RESTED) return this.power < 0 ? "sinking" : "moving";
    return changes(state) ? "changing" : "";
  }

  // What a fault is, and what to do about it; '' without one.
  remedy(bridge, state) {
    const code = bridge?.fault && bridge.fault !== "none" ? bridge.fault : "";
    if (!code) return "";
    const causes = [];
    if (this.setup?.simulated && STALLED.includes(code)) causes.push(ofSimulation(state.simulator));
    if (state.cause && CAUSED.includes(code)) causes.push(causeText(state.cause));
    if (!causes[0] || code !== "motor_silent") causes.push(t(has(`fault.${code}`) ? `fault.${code}` : "fault.unknown")); // no cable is simulated
    return causes.join(" ").trim();
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

  isOver(support) {
    return this.limit !== null && support > this.limit;
  }

  // The support for a wearer's new data: 0 for the first ones; never more than rated torque allows a heavier arm.
  supportFor(mass, sex, lengths) {
    const now = this.setup?.settings ?? {};
    if (!now["wearer.body_mass"] || this.limit === null) return 0;
    const shares = lengths.map((length, n) => (length ? now["wearer.segment_length"][n] / length : 1));
    const share = Math.min(1, ...shares) * (sex === now["wearer.sex"] ? 1 : 0.84); // a man's forearm is the heavier one
    const limit = (this.limit * share * now["wearer.body_mass"]) / mass;
    return Math.min(this.support, Math.floor(200 * limit) / 200);
  }

  get isCarried() {
    return CARRIED.includes(this.state);
  }
}

// The pose in degrees that a start asks about; null without a question.
function poseAsked(bridge) {
  const text = bridge?.["pose to confirm (deg)"] ?? "none";
  return text === "none" ? null : text.split(", ").map(Number);
}

const changes = (state) => (state.compensator?.["changing load"] ?? "none") !== "none";

// The change of load that came shortly before a fault.
function causeText({ what, from, to }) {
  if (what === "payload") return t("cause.payload", number(from, 2), number(to, 2));
  if (what === "support") return t("cause.support", number(100 * from, 1), number(100 * to, 1));
  return what === "mode" ? t("cause.mode", from === "zero_g" ? "Zero-G" : "One-G", to === "zero_g" ? "Zero-G" : "One-G") : t("cause.wearer");
}

// Why a simulated motor seems silent, unless a simulated fault silences it.
function ofSimulation(simulator) {
  if (!simulator) return t("fault.simulator_gone");
  const longest = Math.max(finite(simulator["longest stall (ms)"]), finite(simulator["longest silence (ms)"])); // since the motors are on
  return longest > STALL && simulator.disconnected === "no" ? t("fault.stalled", number(longest, 0)) : "";
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
