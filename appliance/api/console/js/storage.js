/** What the browser stores for the console. It may store nothing: then the page remembers its state until it is closed. */

/** Return a stored text, or null. @param {string} name @param {"localStorage" | "sessionStorage"} [where] */
export function stored(name, where = "localStorage") {
  try {
    return window[where].getItem(name);
  } catch {
    return null;
  }
}

/** Store a text; null removes it. @param {string} name @param {string | null} text @param {"localStorage" | "sessionStorage"} [where] */
export function store(name, text, where = "localStorage") {
  try {
    if (text === null) window[where].removeItem(name);
    else window[where].setItem(name, text);
  } catch {
    // without storage, nothing is stored
  }
}
