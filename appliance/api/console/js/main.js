/** The entry point: try a stored token and render the page. */

import { App } from "./app.js";
import { html, render } from "./html.js";
import { enter } from "./door.js";
import { kept, session } from "./session.js";

const token = kept();
if (token) {
  session.update({ checking: true });
  enter(token, true).catch((error) => session.update({ ended: error.message, checking: false }));
}
render(html`<${App} />`, /** @type {Element} */ (document.getElementById("console")));
