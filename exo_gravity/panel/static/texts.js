// The page's texts in the language that its user chose; strings.json holds them all.

let texts = {};
let column = 0;
const formats = {}; // by language and digits: making one is slow
let changed = () => {};

export async function loadTexts(onChange) {
  const content = await (await fetch("/strings")).json();
  texts = content.texts;
  changed = onChange;
  const select = document.getElementById("language");
  const codes = Object.keys(content.languages);
  for (const code of codes) select.add(new Option(content.languages[code], code));
  select.addEventListener("change", () => {
    localStorage.setItem("language", select.value);
    use(select.value, codes);
  });
  const browser = navigator.languages.map((tag) => tag.slice(0, 2)).find((code) => codes.includes(code));
  return (preferred) => use(localStorage.getItem("language") || (codes.includes(preferred) ? preferred : browser ?? codes[0]), codes);
}

function use(code, codes) {
  column = Math.max(0, codes.indexOf(code));
  document.documentElement.lang = codes[column];
  document.getElementById("language").value = codes[column];
  document.title = t("title");
  translate(document);
  translate(document.getElementById("arm").content);
  changed();
}

export function translate(root) {
  for (const element of root.querySelectorAll("[data-text]")) element.textContent = t(element.dataset.text);
}

export function has(key) {
  return key in texts;
}

// The text of `key`, with {0}, {1}, ... replaced by `values`.
export function t(key, ...values) {
  const text = texts[key]?.[column] ?? key;
  return text.replace(/\{(\d)\}/g, (_, n) => values[n] ?? "");
}

export function number(value, digits) {
  if (value === null || value === undefined) return "–";
  const key = `${document.documentElement.lang}${digits}`;
  formats[key] ??= new Intl.NumberFormat(document.documentElement.lang, { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return formats[key].format(value);
}

// The number in a text of /diagnostics, null if there is none.
export function finite(text) {
  const value = parseFloat(text);
  return Number.isFinite(value) ? value : null;
}

export const degrees = (radians) => (radians === null ? null : (radians * 180) / Math.PI);

// Writes a text only where it differs: screen readers announce each change.
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
