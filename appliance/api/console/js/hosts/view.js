import { html } from "../html.js";
export function Hosts() { return html`<h1>Hosts</h1>`; }
