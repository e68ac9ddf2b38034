// The colours of panel.css for what is drawn on a canvas, read once for each of light and dark.

let known = {};

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => (known = {}));

export function colour(name) {
  known[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  return known[name];
}
