// Short messages, above Let down; each stays long enough to be read, and takes no press.

import { write } from "./texts.js";

const STAYS = 12000; // ms
let timer = null;

export function say(text) {
  const place = document.getElementById("message");
  write(place, text);
  clearTimeout(timer);
  if (text) timer = setTimeout(() => write(place, ""), STAYS);
}
