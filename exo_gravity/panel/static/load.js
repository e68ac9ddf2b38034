// What an arm carries, and what its wearer does: the share of the arm's weight, the weighing, the last contact.

import { finite, has, number, t, write } from "./texts.js";
import { jointText } from "./telling.js";

const WIDEST = 28; // %, half a 95 % band; a wider one does not tell a lifting wearer from a resting one
const inside = (percent) => Math.min(100, Math.max(0, percent));

// How much of their arm's weight the wearer carries, to be read from two metres. It is shown while it means something:
// the arm is carried, a wearer is given, and the band is small. Otherwise it is grey, and says why.
export function showShare(card, wearer, isCarried) {
  const value = finite(wearer?.["share of the wearer (%)"]);
  const band = finite(wearer?.["share band (%)"]);
  const why = whyNoShare(card, wearer, value, band, isCarried);
  const bar = card.find(".bar");
  card.find(".carries").toggleAttribute("data-known", !why);
  write(card.find(".carries strong"), why ? "–" : `${number(value, 0)} %`);
  write(card.find(".width"), why || t("share.band", number(band, 0)));
  bar.setAttribute("aria-valuenow", why ? 0 : inside(value));
  bar.setAttribute("aria-valuetext", why ? t("carries_unknown") : `${number(value, 0)} %`);
  const [low, high] = why ? [0, 0] : [inside(value - band), inside(value + band)];
  card.find(".part").style.width = why ? 0 : `${inside(value)}%`;
  card.find(".band").style.left = `${low}%`;
  card.find(".band").style.width = `${high - low}%`;
}

function whyNoShare(card, wearer, value, band, isCarried) {
  if (!isCarried) return t("share.idle");
  if (!card.hasWearer) return t("share.no_wearer");
  if (!wearer) return t("share.silent");
  if (value === null || band === null) return t("share.none");
  return band > WIDEST ? t("share.wide", number(band, 0)) : "";
}

// The share of each joint's own weight: a whole share hides a joint that carries little. Below the buttons: it may be empty.
export function showJointShares(card, joints, wearer, isCarried) {
  const known = [];
  for (const { name } of isCarried && card.hasWearer && wearer ? (joints ?? []) : []) {
    const value = finite(wearer[`${name} share (%)`]);
    const band = finite(wearer[`${name} share band (%)`]);
    if (value === null || band === null) continue;
    known.push(t(band > WIDEST ? "share.joint_wide" : "share.joint", jointText(card.name, name), number(value, 0), number(band, 0)));
  }
  write(card.find(".shares"), known.length ? t("share.joints", known.join(", ")) : "");
}

// The load in the hand, the weighing, and the last contact.
export function showLoad(card, compensator, wearer, operates, isCarried) {
  const mass = finite(compensator?.["weighed payload (kg)"]);
  const band = finite(compensator?.["weighed payload band (kg)"]);
  card.weighed = mass;
  card.find(".weigh").disabled = !operates || !isCarried;
  const isOld = !isCarried || (mass !== null && Math.abs(mass - card.payload) < 0.001);
  card.find(".carry").hidden = mass === null || isOld;
  card.find(".carry").disabled = !operates;
  write(card.find(".carry"), mass === null ? "" : t("carry_load", number(mass, 2), number(band, 2)));
  write(card.find(".payload"), t("payload_now", number(card.payload, 2)));
  write(card.find(".weighing"), weighingText(compensator, isOld));
  write(card.find(".contact"), contactText(card.name, wearer));
}

// isOld: whether its result is carried, or of an arm that was let down since.
function weighingText(compensator, isOld) {
  const phase = compensator?.weighing ?? "none";
  const isOver = ["none", "done", "failed"].includes(phase);
  if (isOver && isOld) return "";
  const [trouble] = ["weigh refused", "weighing trouble"].map((key) => compensator?.[key]).filter((word) => has(`trouble.${word}`));
  if (isOver && trouble) return t("weighing.failed", t(`trouble.${trouble}`));
  if (phase === "done") return t("weighing.done", number(finite(compensator["weighed mass (kg)"]), 2), number(finite(compensator["weighed band (kg)"]), 2));
  return has(`weighing.${phase}`) ? t(`weighing.${phase}`, number(finite(compensator["weighing time (s)"]), 0)) : "";
}

function contactText(arm, wearer) {
  const torque = finite(wearer?.["contact torque (Nm)"]);
  if (torque === null) return "";
  const age = Math.min(99, finite(wearer["contact age (s)"]));
  return t("contact", jointText(arm, wearer["contact joint"]), `${torque > 0 ? "+" : ""}${number(torque, 1)}`, number(age, 0), wearer.contacts);
}
