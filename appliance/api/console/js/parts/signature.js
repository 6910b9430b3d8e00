/** The signature of the site, where it asks for one. */

import { html } from "../html.js";
import { Field } from "./field.js";

/** @param {{asked: boolean, value: string, set: (value: string) => void}} given `asked`: the appliance has keys of the site */
export function Signature({ asked, value, set }) {
  if (!asked) return null;
  return html`<${Field} label="Signature of the site" rows=${4} mono value=${value} set=${set} placeholder="-----BEGIN SSH SIGNATURE-----" maxlength="8000"
    hint=${html`what <code>rosrv sign FILE --key KEY</code> wrote to <code>FILE.sig</code>; this appliance takes nothing that its site did not sign`} />`;
}
