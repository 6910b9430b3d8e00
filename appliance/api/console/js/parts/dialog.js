/** A modal dialog. Escape and the close button close it; the focus then returns to the previous element. */

import { html, useId, useLayoutEffect, useRef } from "../html.js";
import { Icon } from "./icon.js";

/** @param {{title: string, close: () => void, foot?: any, wide?: boolean, children?: any}} given */
export function Dialog({ title, close, foot, wide = false, children }) {
  const ref = useRef(/** @type {HTMLDialogElement | null} */ (null));
  const id = useId();
  // Not an effect after the drawing: a key that follows belongs to the dialog, and is no shortcut.
  useLayoutEffect(() => {
    const dialog = ref.current;
    const before = /** @type {HTMLElement | null} */ (document.activeElement);
    dialog?.showModal();
    return () => {
      dialog?.close();
      before?.focus?.();
    };
  }, []);
  const cancel = (/** @type {Event} */ event) => {
    event.preventDefault();
    close();
  };
  return html`<dialog ref=${ref} class=${`dialog${wide ? " wide" : ""}`} aria-labelledby=${id} onCancel=${cancel}>
    <div class="dialog-head"><h2 id=${id}>${title}</h2>
      <button class="button plain" onClick=${close} aria-label="Close"><${Icon} name="close" /></button></div>
    <div class="dialog-body">${children}</div>
    ${foot && html`<div class="dialog-foot">${foot}</div>`}
  </dialog>`;
}
