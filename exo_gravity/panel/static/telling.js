// What the keys of an arm on /diagnostics mean to its operator: why, what to do, and the one button that does it.
//
// docs/keys.md has the keys and their words. Sentences of the nodes are shown below for engineers, and never read here.

import { finite, has, number, t } from "./texts.js";

const CAUSED = ["over_speed", "torque_not_delivered", "outside_limits", "unexplained_torque"]; // perhaps by a change of load
const STALLED = ["motor_silent", "torque_not_delivered", "wrong_sign", "sign_unproven"]; // perhaps by a computer that stood still
const STALL = 50; // ms; a simulated arm that stands still for longer seems silent
// Faults after which the arm is not to be carried again before an engineer has seen it
const ENGINEER = ["torque_dipped", "readings_contradict", "wrong_sign", "command_impossible", "watchdog_dead", "internal_error"];
const NONE = "none";

// The names or words of a key; [] for none.
export function list(text) {
  return text && text !== NONE ? text.split(", ") : [];
}

export const changes = (compensator) => list(compensator?.["changing load"]).length > 0;

// The pose in degrees that a start asks about; null without a question.
export function poseAsked(bridge) {
  const angles = list(bridge?.["pose to confirm (deg)"]);
  return angles.length ? angles.map(Number) : null;
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

export const headText = (arm) => (has(`head.${arm}`) ? t(`head.${arm}`) : arm);

export function jointText(arm, name) {
  const leaf = name.replace(`${arm}_`, "");
  return has(`joint.${leaf}`) ? t(`joint.${leaf}`) : capital(leaf.replaceAll("_", " "));
}

// Returns {why, todo, action, engineer}: texts, the name of the button, and whether an engineer must see the arm first.
//
// name: the state that is shown. state: of the arm. moving: what it does in place of resting, '' for nothing. last: the
// last state that its bridge reported, and when; null before the first one.
export function tell(arm, name, state, moving, isSimulated, last) {
  const { bridge } = state;
  const action = actionOf(name, bridge);
  if (name === "silent" || name === "unseen") {
    const time = last?.time.toLocaleTimeString(document.documentElement.lang);
    const known = last ? t("last_report", time, has(`state.${last.name}`) ? t(`state.${last.name}`) : last.name) : "";
    return { why: join([t(`sentence.${name}`), known]), todo: t(isSimulated ? "do.simulation_gone" : `todo.${name}`), action };
  }
  const fault = faultOf(arm, state, isSimulated);
  const unreached = bridge.motors === "unreached";
  const usual = usually(arm, name, state, moving);
  const why = [unreached ? t("unreached") : "", ...(fault?.why ?? [usual.why])];
  const todo = unreached ? [t("do.unreached")] : fault ? [...fault.todo, then(name, bridge)] : [usual.todo];
  return { why: join(why), todo: join(todo), action, engineer: ENGINEER.includes(bridge.fault) };
}

const join = (texts) => texts.filter(Boolean).join(" ");

function actionOf(name, bridge) {
  if (name === "disabled" || name === "inactive") return "enable";
  if (name === "fault") return bridge.resume === "possible" ? "resume" : "clear";
  if (name === "letting down") return "";
  return poseAsked(bridge) ? "look" : "down";
}

// The button to press once a fault is remedied.
function then(name, bridge) {
  if (name !== "fault") return t("then.wait");
  if (bridge.resume === "possible") return t("then.resume");
  return ENGINEER.includes(bridge.fault) ? "" : t("then.clear");
}

// What the state is and what to do, besides a fault.
function usually(arm, name, state, moving) {
  const { bridge, compensator } = state;
  if (poseAsked(bridge)) return texts("pose");
  if (moving) return texts(changes(compensator) ? "changing" : moving);
  const [refusal] = list(bridge.refusal);
  if (name === "disabled" && refusal) return { why: waitText(arm, refusal, bridge, true), todo: t("then.enable") };
  const [wait] = list(bridge["waiting for"]);
  if (name === "proving signs" && !wait) return { why: join([texts(name).why, t("proof", bridge["signs proven (%)"])]), todo: texts(name).todo };
  if (!wait || wait === "pose") return texts(name === "inactive" ? "disabled" : name);
  const reason = wait === "efforts" ? reasonText(compensator) : "";
  return { why: join([waitText(arm, wait, bridge, false), reason]), todo: "" };
}

function texts(key) {
  const of = (kind) => (has(`${kind}.${key}`) ? t(`${kind}.${key}`) : "");
  return { why: of("sentence"), todo: of("todo") };
}

// What a start waits for, or waited for when it ended.
function waitText(arm, word, bridge, hasEnded) {
  const [joint] = list(bridge["joints outside limits"]);
  const [degrees] = list(bridge["turn back (deg)"]);
  if (word === "joint_limits" && joint)
    return t(hasEnded ? "outside.disabled" : "outside.checking", jointText(arm, joint), number(Math.abs(degrees), 1));
  const text = has(`wait.${word}`) ? t(`wait.${word}`) : has(`fault.${word}`) ? t(`fault.${word}`) : word;
  return hasEnded ? t("stayed_off", text) : text;
}

function reasonText(compensator) {
  const [reason] = list(compensator?.reason);
  return reason && has(`reason.${reason}`) ? t(`reason.${reason}`) : "";
}

// What a fault is and what to do about it, each a list of sentences; null without one.
function faultOf(arm, state, isSimulated) {
  const { bridge } = state;
  const [code] = list(bridge.fault);
  if (!code) return null;
  const found = [];
  const stall = isSimulated && STALLED.includes(code) ? ofSimulation(state.simulator) : null;
  if (stall) found.push(stall);
  if (!stall || code !== "motor_silent") { // no cable is simulated
    const key = has(`fault.${code}`) ? code : "unknown";
    const [joint] = list(bridge["fault joint"]);
    const why = t(`fault.${key}`);
    found.push({ why: joint ? `${jointText(arm, joint)}: ${why}` : why, todo: t(`do.${key}`) });
  }
  if (code === "command_withdrawn" && reasonText(state.compensator)) found.push({ why: reasonText(state.compensator) });
  const cause = state.cause && CAUSED.includes(code) ? causeText(state.cause) : "";
  return { why: [...found.map((one) => one.why), cause], todo: cause ? [t("do.cause")] : found.map((one) => one.todo) };
}

// The change of load that came shortly before a fault.
function causeText({ what, from, to }) {
  if (what === "payload") return t("cause.payload", number(from, 2), number(to, 2));
  if (what === "support") return t("cause.support", number(100 * from, 1), number(100 * to, 1));
  return what === "mode" ? t("cause.mode", from === "zero_g" ? "Zero-G" : "One-G", to === "zero_g" ? "Zero-G" : "One-G") : t("cause.wearer");
}

// Why a simulated motor seems silent, unless a simulated fault silences it; null where nothing shows it.
function ofSimulation(simulator) {
  if (!simulator) return { why: t("fault.simulator_gone"), todo: t("do.simulator_gone") };
  const longest = Math.max(finite(simulator["longest stall (ms)"]), finite(simulator["longest silence (ms)"])); // since the motors are on
  if (longest <= STALL || simulator.disconnected !== "no") return null;
  return { why: t("fault.stalled", number(longest, 0)), todo: t("do.stalled") };
}
