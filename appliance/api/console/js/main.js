/** The entry point: complete a sign-in at the provider or try a stored token, and render the page. */

import { App } from "./app.js";
import { html, render } from "./html.js";
import { resume } from "./door.js";
import { kept } from "./session.js";
import { complete, returned } from "./sign-on.js";

if (returned()) complete();
else if (kept()) resume();
render(html`<${App} />`, /** @type {Element} */ (document.getElementById("console")));
