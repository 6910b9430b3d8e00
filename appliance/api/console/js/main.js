/** The entry point: try a stored token and render the page. */

import { App } from "./app.js";
import { html, render } from "./html.js";
import { resume } from "./door.js";
import { kept } from "./session.js";

if (kept()) resume();
render(html`<${App} />`, /** @type {Element} */ (document.getElementById("console")));
