// Asks once before something that moves an arm. The rest of the page stays usable: Let down works while this is open.

import { write } from "./texts.js";

const dialog = document.getElementById("ask");
let current = null; // the question, {answered, resolve}
let opener = null; // what has the focus again afterwards

// Prepares a question, which is not seen before `show`. An earlier one is answered no. Its `answered` is a promise.
export function prepare(head, text, yes) {
  close(false);
  opener = document.activeElement;
  const question = {};
  question.answered = new Promise((resolve) => (question.resolve = resolve));
  current = question;
  writeTexts(head, text, yes);
  return question;
}

// Shows a question with these texts, unless it was answered or replaced meanwhile.
export function show(question, head, text, yes) {
  if (question !== current) return;
  writeTexts(head, text, yes);
  if (dialog.open) return;
  dialog.show();
  document.getElementById("ask-no").focus();
}

// Ends a question with no.
export function drop(question) {
  if (question === current) close(false);
  else question.resolve(false);
}

export function ask(head, text, yes) {
  const question = prepare(head, text, yes);
  show(question, head, text, yes);
  return question.answered;
}

export function close(value) {
  const question = current;
  current = null;
  if (dialog.open) {
    dialog.close();
    opener?.focus();
  }
  question?.resolve(value);
}

function writeTexts(head, text, yes) {
  write(document.getElementById("ask-head"), head);
  write(document.getElementById("ask-text"), text);
  write(document.getElementById("ask-yes"), yes);
}

document.getElementById("ask-no").addEventListener("click", () => close(false));
document.getElementById("ask-yes").addEventListener("click", () => close(true));
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") close(false);
});
