/** A button that copies an id or a command. */

import { html } from "../html.js";
import { Icon } from "./icon.js";
import { done, failed } from "./toast.js";

const COMMAND = /\brosrv [a-z][^;]*$/;

/** @param {{text: string, what: string}} given `what`: a word for it, such as "id" */
export function Copy({ text, what }) {
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(text);
      done(`The ${what} is copied`);
    } catch {
      failed(new Error("This browser does not let the page copy: select the text, and copy it."));
    }
  };
  return html`<button type="button" class="button plain small copy" aria-label=${`Copy the ${what}`} title=${text} onClick=${copy}><${Icon} name="copy" size=${14} /></button>`;
}

/** The button for the command at the end of a sentence, if it has one. @param {{text: string}} given */
export function CopyCommand({ text }) {
  const [command] = COMMAND.exec(text) ?? [];
  return command ? html`<${Copy} text=${command} what="command" />` : null;
}
