// Asks once before something that moves an arm. The rest of the page stays usable: Let down works while this is open.

import { write } from "./texts.js";

const dialog = document.getElementById("ask");
let answer = () => {};
let opener = null;

export function ask(head, text, yes) {
  close(false);
  write(document.getElementById("ask-head"), head);
  write(document.getElementById("ask-text"), text);
  write(document.getElementById("ask-yes"), yes);
  opener = document.activeElement;
  dialog.show();
  document.getElementById("ask-no").focus();
  return new Promise((resolve) => {
    answer = resolve;
  });
}

export function close(value) {
  if (!dialog.open) return;
  dialog.close();
  opener?.focus();
  answer(value);
}

document.getElementById("ask-no").addEventListener("click", () => close(false));
document.getElementById("ask-yes").addEventListener("click", () => close(true));
dialog.addEventListener("keydown", (event) => {
  if (event.key === "Escape") close(false);
});
