// The page: takes the state, shows it, and sends what its user asks for. Let down comes first.

import { ArmCard } from "./arm.js";
import { ask, close as closeAsk, drop, prepare, show as showAsk } from "./ask.js";
import { connect, letDown, link, request, settingsOf, watch } from "./link.js";
import { Plots } from "./plots.js";
import { Picture } from "./picture.js";
import { say } from "./say.js";
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
let downs = 0; // how often it was asked for

async function down(arm) {
  downs += 1;
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

let sent = 0; // how many requests were sent

// done: what is said once it is carried out. Answers may come in another order: only that of the newest request takes
// away what is said, but each refusal is said.
async function send(body, done = "") {
  sent += 1;
  const turn = sent;
  const problem = await request(body);
  if (problem !== "" || turn === sent) say(problem === null ? t("unsent") : problem ? t("refused", problem) : done);
  return problem === "";
}

// Asks about the settings in force, not about those that the page has seen last: they are read from the arms before the
// question is seen, and again after the answer. If they have changed meanwhile, it asks again. Let down ends it.
//
// compose: returns heading, text and button of the question, from the cards; null where there is nothing to ask.
async function sure(asked, compose) {
  const since = downs;
  const known = compose();
  let question = known && prepare(...known);
  let agreed = null;
  for (;;) {
    const problem = await refresh(asked);
    const texts = compose();
    const isDown = downs !== since; // Let down was pressed meanwhile
    if (problem && !isDown) say(t("settings_unread", problem));
    if (problem || isDown || !texts || texts[1] === agreed) {
      if (question) drop(question);
      return !problem && !isDown;
    }
    question ??= prepare(...texts);
    showAsk(question, ...texts);
    if (!(await question.answered)) return false;
    agreed = texts[1];
    question = null;
  }
}

// Reads the settings of these cards' arms; returns why that failed, or ''.
async function refresh(asked) {
  const answers = await Promise.all(asked.map((card) => settingsOf(card.name)));
  answers.forEach(({ settings }, n) => {
    const setup = asked[n].setup;
    if (settings) asked[n].configure({ ...setup, settings: { ...setup.settings, ...settings } });
  });
  return answers.map(({ error }) => error).find(Boolean) ?? "";
}

const ASKED = 0.1; // a larger change of the support of an arm that is carried is asked about: it may be a slip
const percent = (card) => number(100 * card.carriedShare, 1);
const actions = {
  send,
  down,
  sure,
  async enable(card) {
    const isSure = await sure([card], () => {
      const over = card.mode === "zero_g" && card.isOver(card.support) ? t("support_over") : "";
      const text = `${t("enable_ask")} ${t(`enable_mode.${card.mode}`, percent(card))} ${over}`;
      return [t("enable_arm", card.armText()), text, t("enable")];
    });
    if (isSure) send({ do: card.state === "inactive" ? "activate" : "enable", arm: card.name });
  },
  async mode(card, mode) {
    if (mode === card.mode) return;
    const isSure = await sure([card], () => {
      const text = mode === "zero_g" ? t("zero_g_ask") : t("one_g_ask", percent(card));
      return mode === "zero_g" || card.isCarried ? [t(`mode.${mode}`), text, t(`mode.${mode}`)] : null;
    });
    if (isSure) send({ do: "set", arm: card.name, values: mode === "zero_g" ? { mode, support: 0 } : { mode } });
  },
  async weigh(card) {
    if (await ask(t("weigh_arm", card.armText()), t("weigh_ask"), t("weigh"))) send({ do: "weigh", arm: card.name });
  },
  async carry(card, mass) {
    const kilograms = Math.round(1000 * mass) / 1000;
    const isSure = await sure([card], () => [t("payload"), t("carry_ask", number(card.payload, 2), number(kilograms, 2)), t("change")]);
    if (isSure) send({ do: "set", arm: card.name, values: { "payload.mass": kilograms } });
  },
  // Returns whether the support was taken.
  async support(card, support) {
    const isSure = await sure([card], () => {
      const over = card.isOver(support) && support > card.support;
      const far = card.isCarried && card.mode === "zero_g" && Math.abs(support - card.support) > ASKED;
      const text = `${t("support_ask", percent(card), number(100 * support, 1))} ${over ? t("support_over") : ""}`;
      return over || far ? [t("support_title"), text, t("change")] : null;
    });
    return isSure && send({ do: "set", arm: card.name, values: { support } });
  },
};

const sections = new Sections(actions, cards);
const plots = new Plots(byId("plots"), byId("figures"));
const picture = new Picture(byId("picture"));

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
    chips.children[n].toggleAttribute("data-moves", card.root.hasAttribute("data-moves"));
    write(chips.children[n], card.summary());
  });
  // Red while it can do something; pressed, it always asks the arms.
  const all = [...cards.values()];
  const isVain = link.alive && all.length > 0 && all.every((card) => card.isDown);
  byId("let-down").toggleAttribute("data-off", isVain);
  const goes = all.some((card) => card.state === "letting down") ? "let_down_runs" : "let_down_off";
  write(byId("let-down-hint"), t(isVain ? goes : "let_down_hint"));
  const { on, foreign, seconds } = state.recording;
  byId("light").hidden = !(link.alive && (on || foreign));
  const clock = `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
  write(byId("light"), on ? t("recording_light", clock) : t("recording"));
  showSource();
}

// Whether the arms are simulated: in one word where all are alike.
function showSource() {
  const all = [...cards.values()];
  const sources = new Set(all.map((card) => card.source));
  const place = byId("source");
  place.hidden = !all.length;
  place.dataset.source = sources.has("simulated") ? "simulated" : sources.has("unknown") ? "unknown" : "real";
  const each = all.map((card) => `${card.headText()}: ${t(`source.${card.source}`)}`);
  write(place, sources.size === 1 ? t(`source.${place.dataset.source}`) : each.join(", "));
}

// The pose to which the running step of a trial leads the arms; null without one.
function targetOf(trial) {
  const step = trial.phase === "running" ? trial.steps?.[trial.step] : null;
  return step?.action === "move" ? step.value : null;
}

function showConnection() {
  mayAlarm ||= link.alive;
  write(byId("connection"), link.alive ? t("connected") : t(mayAlarm ? "not_connected" : "connecting"));
  byId("connection").toggleAttribute("data-alive", link.alive);
  if (byId("alarm").dataset.down) return;
  const lost = setup?.dead_man ? t("lost_dead_man") : t("lost");
  write(byId("alarm"), link.alive || !mayAlarm ? "" : link.full ? t("full") : lost);
}

function showControl(operates) {
  const holder = state.control;
  const elsewhere = operates && holder.elsewhere;
  const yours = elsewhere ? t("control_elsewhere", elsewhere, link.number) : t("control_yours", link.number);
  const who = !link.alive ? "" : !holder ? t("control_none") : operates ? yours : holder.gone ? t("control_gone", holder.page, holder.address) : t("control_other", holder.page, holder.address, link.number);
  write(byId("control-text"), setup.dead_man ? `${who} ${t("dead_man_on")}` : who);
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
  sections.translate();
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
