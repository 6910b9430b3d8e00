// Set the theme before the page is painted: the theme chosen in this browser, or else the system's theme.
"use strict";
(() => {
  let chosen = /** @type {string | null} */ (null);
  try {
    chosen = localStorage.getItem("rosrv.theme");
  } catch {
    // without storage, the system's theme is used
  }
  const dark = chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  document.documentElement.dataset.theme = dark ? "dark" : "light";
})();
