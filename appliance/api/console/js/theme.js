/** The dark or light theme: the system's until the switch is used. */

import { createStore } from "./store.js";

const KEY = "rosrv.theme";
const system = matchMedia("(prefers-color-scheme: dark)");

export const theme = createStore(/** @type {"dark" | "light"} */ (document.documentElement.dataset.theme ?? "light"));

theme.subscribe(() => {
  document.documentElement.dataset.theme = theme.get();
});

system.addEventListener("change", () => {
  if (!remembered()) theme.set(system.matches ? "dark" : "light");
});

export function switchTheme() {
  const next = theme.get() === "dark" ? "light" : "dark";
  try {
    localStorage.setItem(KEY, next);
  } catch {
    // without storage, the theme lasts until the page is closed
  }
  theme.set(next);
}

function remembered() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}
