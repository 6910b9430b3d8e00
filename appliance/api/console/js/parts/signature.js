/** The site's signature, if site keys are configured. */

import { html } from "../html.js";
import { Field } from "./field.js";

/** @param {{asked: boolean, value: string, set: (value: string) => void}} given `asked`: site keys are configured */
export function Signature({ asked, value, set }) {
  if (!asked) return null;
  return html`<${Field} label="Site signature" rows=${4} mono value=${value} set=${set} placeholder="-----BEGIN SSH SIGNATURE-----" maxlength="8000"
    hint=${html`the contents of <code>FILE.sig</code> from <code>rosrv sign FILE --key KEY</code>; this appliance requires a signature`} />`;
}
