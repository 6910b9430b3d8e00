/** The dark or light theme: the system's until the switch is used. */

import { store, stored } from "./storage.js";
import { createStore } from "./store.js";

const KEY = "rosrv.theme";
const system = matchMedia("(prefers-color-scheme: dark)");

export const theme = createStore(/** @type {"dark" | "light"} */ (document.documentElement.dataset.theme ?? "light"));

theme.subscribe(() => {
  document.documentElement.dataset.theme = theme.get();
});

system.addEventListener("change", () => {
  if (!stored(KEY)) theme.set(system.matches ? "dark" : "light");
});

export function switchTheme() {
  const next = theme.get() === "dark" ? "light" : "dark";
  store(KEY, next);
  theme.set(next);
}
