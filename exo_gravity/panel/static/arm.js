// The card of one arm: its state, why, what to do and the button that does it; below its mode, support, load and joints.

import { showJointShares, showLoad, showShare } from "./load.js";
import { changes, headText, jointText, poseAsked, tell } from "./telling.js";
import { degrees, finite, has, number, t, translate, write } from "./texts.js";

const SIGNS = { inactive: "○", disabled: "○", checking: "◔", "proving signs": "◑", "ramping in": "◕", active: "●", "letting down": "▼", fault: "✖", silent: "?", unseen: "?" };
const PAUSE = 300; // ms without a move of the slider after which its support is asked for
const SETTLING = 2000; // ms after that until the parameters in force are known again
const FRESH = 700; // ms for which a button that has just appeared takes no press: the finger was on its way to another
const CARRIED = ["proving signs", "ramping in", "active"];
const STILL = 0.08; // rad/s; slower joints rest
const MEAN = 3; // states over which speed and power are averaged: a velocity is noisy
const RESTED = 1000; // ms at rest after which an arm no longer moves
const DOWN = ["inactive", "disabled", "fault"];
const OFF = [...DOWN, "checking"]; // the motors are off

export class ArmCard {
  constructor(name, actions) {
    this.name = name;
    this.actions = actions;
    this.setup = null;
    this.source = "unknown";
    this.limit = null; // the largest support 0..1 within the motors' rated torque
    this.limited = {}; // the settings for which that was found: new ones have none for up to a second
    this.isDown = false; // whether to let it down would change nothing
    this.adapts = ""; // what the support that adapts does
    this.weighed = null; // kg
    this.names = []; // of the joints
    this.hasWearer = true; // as its compensator says
    this.root = document.getElementById("arm").content.cloneNode(true).firstElementChild;
    this.root.dataset.arm = name;
    this.pose = document.getElementById("pose").content.cloneNode(true).firstElementChild; // stands below the picture
    this.pose.dataset.arm = name;
    this.pose.querySelector("button").addEventListener("click", () => actions.send({ do: "confirm_pose", arm: name }));
    this.find = (selector) => this.root.querySelector(selector);
    this.find("h2").id = `head-${name}`;
    this.root.setAttribute("aria-labelledby", `head-${name}`);
    this.slider = this.find("input");
    this.slider.disabled = true; // until the support in force is known
    this.timer = null;
    this.moved = -Infinity; // ms, when its user moved the slider or the support was sent
    this.speed = this.power = 0; // means of the joints' largest speed in rad/s, and of the motors' power in W
    this.went = -Infinity; // ms, when the arm last moved
    this.last = null; // the last state that its bridge reported, and when
    this.action = ""; // the button that is seen
    this.appeared = -Infinity; // ms, since when
    this.find(".enable").addEventListener("click", () => actions.enable(this));
    this.find(".look").addEventListener("click", () => this.look());
    for (const [part, kind] of Object.entries({ clear: "clear_fault", resume: "resume", home: "bring_home" }))
      this.find(`.${part}`).addEventListener("click", () => actions.send({ do: kind, arm: name }));
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
    write(this.find("h2"), this.headText());
    this.find(".enable").setAttribute("aria-label", t("enable_arm", arm));
    this.find(".look").setAttribute("aria-label", t("look_arm", arm));
    this.find(".clear").setAttribute("aria-label", t("clear_fault_arm", arm));
    this.find(".resume").setAttribute("aria-label", t("resume_arm", arm));
    this.find(".home").setAttribute("aria-label", t("bring_home_arm", arm));
    this.find(".weigh").setAttribute("aria-label", t("weigh_arm", arm));
    this.find(".bar").setAttribute("aria-label", t("carries_arm", arm));
    write(this.find(".down"), t("let_down_arm", arm));
    write(this.pose.querySelector("button"), t("confirm_pose", arm));
  }

  armText() {
    return has(`arm.${this.name}`) ? t(`arm.${this.name}`) : this.name;
  }

  headText() {
    return headText(this.name);
  }

  get state() {
    return this.root.dataset.state;
  }

  // State, mode and support in one line.
  summary() {
    const mode = this.mode === "zero_g" ? `Zero-G, ${number(100 * this.carriedShare, 0)} %` : "One-G";
    return `${this.find(".sign").textContent} ${this.headText()}: ${this.find(".state").textContent} · ${mode}`;
  }

  get support() {
    return this.setup?.settings?.support ?? NaN;
  }

  // The share of the wearer's arm that the motors carry: none in One-G, or without a wearer.
  get carriedShare() {
    return this.mode === "zero_g" && this.hasWearer ? this.support : 0;
  }

  get mode() {
    return this.setup?.settings?.mode ?? "one_g";
  }

  get payload() {
    return this.setup?.settings?.["payload.mass"] ?? 0;
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
    if (isFinite(this.carriedShare)) this.slider.value = 100 * this.carriedShare;
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
    const now = 100 * this.carriedShare;
    const known = limit !== null;
    const mark = this.find(".mark");
    mark.hidden = !known;
    if (known) mark.style.left = `${100 * limit}%`;
    write(this.find("output"), Math.abs(now - value) > 0.05 ? `${number(value, 1)} % (${t("support_now", number(now, 1))})` : `${number(value, 1)} %`);
    this.slider.setAttribute("aria-valuetext", `${number(value, 1)} %`);
    const parts = [known ? t("support_limit", number(Math.floor(1000 * limit) / 10, 1)) : this.hasWearer ? "" : t("support_nobody")];
    if (known && value / 100 > limit) parts.push(t("support_over"));
    if (this.mode === "one_g") parts.push(t("support_unused"));
    parts.push(this.adapts);
    write(this.find(".limit"), parts.filter(Boolean).join(" "));
  }

  // The state, ten times a second.
  show(state, operates, alive) {
    const bridge = alive ? state.bridge : null;
    const name = bridge ? bridge.state || "disabled" : alive ? "silent" : "unseen";
    const moving = name === "active" ? this.motion(state) : "";
    if (state.simulator) this.source = "simulated";
    else if (alive && this.source !== "simulated") this.source = bridge?.source ?? this.setup?.source ?? "unknown";
    if (bridge) this.last = { name, time: new Date() };
    this.showState(name, moving);
    const told = tell(this.name, name, state, moving, this.source === "simulated", this.last);
    write(this.find(".sentence"), told.why);
    this.find(".remedy").hidden = !told.todo;
    write(this.find(".remedy"), told.todo);
    this.showAction(told, name, operates);
    const compensator = alive ? state.compensator : null;
    const wearer = alive ? state.wearer : null;
    const limit = finite(wearer?.["largest support"]);
    if (limit !== this.limit) this.limited = this.setup?.settings ?? {};
    this.limit = limit;
    if (compensator) this.hasWearer = /[1-9]/.test(compensator["wearer mass (kg)"]);
    this.isDown = name === "letting down" || (DOWN.includes(name) && (bridge.motors ?? "off") === "off");
    this.adapts = this.adaptsText(wearer);
    showShare(this, wearer, name === "active");
    showLoad(this, compensator, wearer, operates, name === "active");
    this.root.classList.toggle("stale", !alive);
    this.names = state.joints?.map((joint) => joint.name) ?? this.names;
    this.showPose(bridge, operates);
    this.find(".home").hidden = this.source !== "simulated";
    this.find(".home").disabled = !operates || !OFF.includes(name);
    const known = operates && compensator && isFinite(this.support);
    for (const button of this.root.querySelectorAll("[data-mode]")) button.disabled = !known;
    this.slider.disabled = !known || this.mode !== "zero_g" || !this.hasWearer;
    if (this.setup?.settings) this.follow();
    this.showSupport();
    this.showJoints(alive ? state.joints : null, bridge);
    showJointShares(this, alive ? state.joints : null, wearer, name === "active");
    this.showReports(bridge, compensator, alive);
  }

  showState(name, moving) {
    for (const element of [this.root, this.find(".badge")]) {
      element.dataset.state = name;
      element.toggleAttribute("data-moves", moving !== "");
    }
    write(this.find(".sign"), SIGNS[name] ?? "?");
    write(this.find(".state"), moving ? t(moving) : has(`state.${name}`) ? t(`state.${name}`) : name);
  }

  // The one button that does what is to be done; beside Carry again also Clear fault.
  showAction({ action, engineer }, name, operates) {
    const now = performance.now();
    if (action !== this.action) this.appeared = now;
    this.action = action;
    const settled = operates && now - this.appeared >= FRESH;
    this.find(".act").toggleAttribute("data-two", action === "resume");
    for (const kind of ["enable", "look", "resume", "clear", "down"]) {
      const isSeen = kind === action || (kind === "clear" && action === "resume");
      this.find(`.${kind}`).toggleAttribute("data-on", isSeen);
      if (kind !== "down") this.find(`.${kind}`).disabled = !isSeen || !settled; // what lets down always works
    }
    this.find(".clear").toggleAttribute("data-plain", Boolean(engineer));
  }

  // Shows the picture with the question below it.
  look() {
    document.getElementById("seen").scrollIntoView({ block: "start" });
    this.pose.querySelector("button").focus({ preventScroll: true });
  }

  adaptsText(wearer) {
    const word = wearer?.["support adapts"] ?? "off";
    if (word === "off") return "";
    const asked = finite(wearer["support asked for"]) ?? this.support;
    const text = t("support_adapts", number(100 * this.support, 0), number(100 * asked, 0));
    return word === "held" ? `${text} ${t("support_held")}` : text;
  }

  // Whether the operator is asked if the arm hangs as it is drawn, and at which angles.
  showPose(bridge, operates) {
    const angles = poseAsked(bridge);
    this.pose.hidden = !angles;
    this.pose.querySelector("button").disabled = !operates;
    write(this.pose.querySelector("p"), angles ? t("confirm_pose_ask", this.armText(), this.poseText(angles)) : "");
  }

  // angles: of the joints, in degrees.
  poseText(angles) {
    return angles.map((angle, n) => `${jointText(this.name, this.names[n] ?? "")} ${number(angle, 0)}°`).join(", ");
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
    return changes(state.compensator) ? "changing" : "";
  }

  showJoints(joints, bridge) {
    const body = this.find("tbody");
    const rows = joints ?? [];
    while (body.rows.length > rows.length) body.deleteRow(-1);
    rows.forEach((joint, n) => {
      const row = body.rows[n] ?? newRow(body);
      const limit = this.setup?.max_effort?.[n];
      const cells = [jointText(this.name, joint.name), `${number(degrees(joint.position), 1)}°`, `${number(joint.effort, 2)} / ${number(limit, 1)}`, `${number(temperature(joint, bridge), 0)} °C`];
      cells.forEach((text, column) => write(row.cells[column], text));
    });
  }

  // For engineers: rates, and what the nodes say.
  showReports(bridge, compensator, alive) {
    const mass = finite(compensator?.["mass carried (kg)"]);
    write(this.find(".carried"), mass === null ? "" : t("carried", number(mass, 2)));
    const rates = bridge ? `${t("rate")}: ${number(finite(bridge["rate (Hz)"]), 1)} Hz. ${t("age")}: ${number(finite(bridge["age of efforts (ms)"]), 1)} ms.` : "";
    const causes = [["limits", "limits acting"], ["damping", "damped by"]].filter(([, key]) => (bridge?.[key] ?? "none") !== "none");
    write(this.find(".rates"), [rates, ...causes.map(([text, key]) => t(text, bridge[key]))].join(" "));
    write(this.find(".detail"), bridge?.message ? t("detail", bridge.message) : "");
    const silent = alive ? t("compensator_silent") : "";
    write(this.find(".compensator"), compensator?.message ? t("compensator_detail", compensator.message) : silent);
  }

  isOver(support) {
    return this.limit !== null && support > this.limit;
  }

  // The support for a wearer's new data: 0 for the first ones; never more than rated torque allows a heavier arm.
  supportFor(mass, sex, lengths) {
    const now = this.limited;
    if (!this.setup?.settings?.["wearer.body_mass"] || !now["wearer.body_mass"] || this.limit === null) return 0;
    const shares = lengths.map((length, n) => (length ? now["wearer.segment_length"][n] / length : 1));
    const share = Math.min(1, ...shares) * (sex === now["wearer.sex"] ? 1 : 0.84); // a man's forearm is the heavier one
    const limit = (this.limit * share * now["wearer.body_mass"]) / mass;
    return Math.min(this.support, Math.floor(200 * limit) / 200);
  }

  get isCarried() {
    return CARRIED.includes(this.state);
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
