import { html } from "../html.js";
export function Monitors() { return html`<h1>Monitors</h1>`; }
