// Before anything is painted: the theme that was chosen here before, else the one the reader's system has.
"use strict";
(() => {
  let chosen = /** @type {string | null} */ (null);
  try {
    chosen = localStorage.getItem("rosrv.theme");
  } catch {
    // storage is closed to this page: the system's theme it is
  }
  const dark = chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  document.documentElement.dataset.theme = dark ? "dark" : "light";
})();
