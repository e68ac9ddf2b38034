// The page: takes the state, shows it, and sends what its user asks for. Let down comes first.

import { ArmCard } from "./arm.js";
import { ask, close as closeAsk } from "./ask.js";
import { connect, letDown, link, request, watch } from "./link.js";
import { Plots } from "./plots.js";
import { Picture } from "./picture.js";
import { Sections } from "./sections.js";
import { degrees, loadTexts, number, t, write } from "./texts.js";

const byId = (id) => document.getElementById(id);
const cards = new Map();
let state = null;
let setup = null;
let mayAlarm = false; // once the page has been connected

// Let down

const button = byId("let-down");
let pressed = 0;

async function down(arm) {
  closeAsk(false);
  const problem = await letDown(arm);
  if (problem === "") return say(t("let_down_sent"));
  byId("alarm").dataset.down = "failed";
  write(byId("alarm"), t("let_down_failed", problem ?? t("unsent")));
}

function pressDown() {
  if (performance.now() - pressed < 300) return; // the click that follows the same touch
  pressed = performance.now();
  delete byId("alarm").dataset.down;
  down();
}

button.addEventListener("pointerdown", pressDown);
button.addEventListener("click", pressDown);
// The space bar lets down, whatever has the focus; Enter presses buttons.
document.addEventListener(
  "keydown",
  (event) => {
    if (event.code !== "Space") return;
    event.preventDefault();
    event.stopPropagation();
    if (!event.repeat) pressDown();
  },
  true,
);
document.addEventListener("keyup", (event) => event.code === "Space" && event.preventDefault(), true);

// What the arms' cards ask for

const say = (text) => write(byId("message"), text);

async function send(body) {
  const problem = await request(body);
  say(problem === null ? t("unsent") : problem ? t("refused", problem) : "");
  return problem === "";
}

const ASKED = 0.1; // a larger change of the support of an arm that is carried is asked about: it may be a slip
const percent = (card) => number(100 * card.support, 1);
const actions = {
  send,
  down,
  async enable(card) {
    const over = card.mode === "zero_g" && card.isOver(card.support) ? t("support_over") : "";
    const text = `${t("enable_ask")} ${t(`enable_mode.${card.mode}`, percent(card))} ${over}`;
    if (await ask(t("enable_arm", card.armText()), text, t("enable"))) send({ do: "enable", arm: card.name });
  },
  async mode(card, mode) {
    if (mode === card.mode) return;
    const text = mode === "zero_g" ? t("zero_g_ask") : t("one_g_ask", percent(card));
    if ((mode === "zero_g" || card.isCarried) && !(await ask(t(`mode.${mode}`), text, t(`mode.${mode}`)))) return;
    send({ do: "set", arm: card.name, values: mode === "zero_g" ? { mode, support: 0 } : { mode } });
  },
  async weigh(card) {
    if (await ask(t("weigh_arm", card.armText()), t("weigh_ask"), t("weigh"))) send({ do: "weigh", arm: card.name });
  },
  async carry(card, mass) {
    const kilograms = Math.round(1000 * mass) / 1000;
    const text = t("carry_ask", number(card.payload, 2), number(kilograms, 2));
    if (await ask(t("payload"), text, t("change"))) send({ do: "set", arm: card.name, values: { "payload.mass": kilograms } });
  },
  // Returns whether the support was taken.
  async support(card, support) {
    const over = card.isOver(support) && support > card.support;
    const far = card.isCarried && card.mode === "zero_g" && Math.abs(support - card.support) > ASKED;
    const text = `${t("support_ask", percent(card), number(100 * support, 1))} ${over ? t("support_over") : ""}`;
    if ((over || far) && !(await ask(t("support_title"), text, t("change")))) return false;
    return send({ do: "set", arm: card.name, values: { support } });
  },
};

const sections = new Sections(send, cards);
const plots = new Plots(byId("plots"));
const picture = new Picture(byId("picture"), byId("views"));

// What arrives

function onSetup(message) {
  setup = message;
  for (const [name, arm] of Object.entries(message.arms ?? {})) {
    if (!cards.has(name)) {
      cards.set(name, new ArmCard(name, actions));
      byId("arms").append(cards.get(name).root);
      byId("poses").append(cards.get(name).pose);
    }
    cards.get(name).configure(arm);
  }
  plots.configure(message.arms ?? {});
  picture.configure(message.urdf);
  sections.configure(message);
}

function onState(message) {
  state = message;
  show();
  if (!document.hidden) {
    plots.add(message.arms);
    picture.pose(message.arms, message.tilt, setup?.arms ?? {}, targetOf(message.trial));
  }
}

function show() {
  if (!setup || !state) return;
  const operates = link.alive && state.control?.page === link.number;
  for (const [name, card] of cards) if (state.arms[name]) card.show(state.arms[name], operates, link.alive);
  byId("no-arm").hidden = cards.size > 0;
  showBar();
  showConnection();
  showControl(operates);
  sections.show(state, operates);
  const tilt = state.tilt;
  write(byId("tilt"), tilt ? t("tilt", lean(tilt.pitch, "tilt.forward", "tilt.back"), lean(tilt.roll, "tilt.right", "tilt.left")) : t("tilt_none"));
}

const lean = (angle, towards, away) => `${number(Math.abs(degrees(angle)), 1)}° ${t(angle < 0 ? away : towards)}`;

// The bar that stays in sight: each arm in a few words, and whether a recording runs.
function showBar() {
  const chips = byId("chips");
  while (chips.children.length > cards.size) chips.lastElementChild.remove();
  while (chips.children.length < cards.size) chips.append(Object.assign(document.createElement("li"), { className: "badge" }));
  [...cards.values()].forEach((card, n) => {
    chips.children[n].dataset.state = card.state;
    chips.children[n].toggleAttribute("data-moves", card.moves);
    write(chips.children[n], card.summary());
  });
  const off = link.alive && cards.size > 0 && [...cards.values()].every((card) => card.state === "disabled");
  byId("let-down").toggleAttribute("data-off", off);
  write(byId("let-down-hint"), t(off ? "let_down_off" : "let_down_hint"));
  byId("light").hidden = !(link.alive && (state.recording.on || state.recording.foreign));
  byId("simulated").hidden = !Object.values(setup.arms ?? {}).some((arm) => arm.simulated);
}

// The pose to which the running step of a trial leads the arms; null without one.
function targetOf(trial) {
  const step = trial.phase === "running" ? trial.steps?.[trial.step] : null;
  return step?.action === "move" ? step.value : null;
}

function showConnection() {
  mayAlarm ||= link.alive;
  const words = link.alive ? t("connected") : t("connecting");
  write(byId("connection"), setup?.dead_man ? `${words}. ${t("dead_man_on")}` : words);
  if (byId("alarm").dataset.down) return;
  const lost = setup?.dead_man ? t("lost_dead_man") : t("lost");
  write(byId("alarm"), link.alive || !mayAlarm ? "" : link.full ? t("full") : lost);
}

function showControl(operates) {
  const holder = state.control;
  const elsewhere = operates && holder.elsewhere;
  const yours = elsewhere ? t("control_elsewhere", elsewhere, link.number) : t("control_yours", link.number);
  const text = !link.alive ? "" : !holder ? t("control_none") : operates ? yours : holder.gone ? t("control_gone", holder.page, holder.address) : t("control_other", holder.page, holder.address, link.number);
  write(byId("control-text"), text);
  byId("take").hidden = (operates && !(elsewhere && setup.dead_man)) || !link.alive;
  byId("release").hidden = !operates;
}

byId("take").addEventListener("click", async () => {
  const holder = state?.control;
  const free = !holder || holder.gone;
  const question = holder?.page === link.number ? t("take_elsewhere", holder.elsewhere) : t("take_ask", holder?.page, holder?.address);
  if (free || (await ask(t("take"), question, t("take")))) send({ do: "take" });
});
byId("release").addEventListener("click", () => send({ do: "release" }));

const useLanguage = await loadTexts(() => {
  for (const card of cards.values()) {
    card.translate();
    if (card.setup) card.configure(card.setup);
  }
  plots.translate();
  show();
});
let chosen = false;
connect({
  setup(message) {
    if (!chosen) useLanguage(message.language);
    chosen = true;
    onSetup(message);
  },
  state: onState,
});
watch(show);
