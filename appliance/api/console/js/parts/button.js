/** Buttons that show why they are disabled, such as a missing role. */

import { html, useState } from "../html.js";
import { may, session } from "../session.js";
import { useStore } from "../store.js";

/**
 * @param {{role?: "viewer" | "investigator" | "operator" | "admin", tone?: string, small?: boolean, disabled?: boolean, why?: string,
 *   onClick: () => any, children?: any, [more: string]: any}} given
 * `why`: the reason why the button is disabled. While a click's promise is pending, the button cannot be clicked again.
 */
export function Button({ role = "viewer", tone = "", small = false, disabled = false, why, onClick, children, ...more }) {
  useStore(session);
  const [busy, setBusy] = useState(false);
  const allowed = may(role);
  const reason = allowed ? (disabled ? why : undefined) : `For the role ${role}${role === "operator" ? " or admin" : ""}; yours is ${session.get().current?.role ?? "none"}`;
  const off = !allowed || disabled || busy;
  const click = async () => {
    if (off) return;
    setBusy(true);
    try {
      await onClick();
    } finally {
      setBusy(false);
    }
  };
  return html`<button type="button" class=${`button ${tone}${small ? " small" : ""}`} aria-disabled=${off ? "true" : undefined}
    aria-busy=${busy ? "true" : undefined} ...${more} title=${reason ?? more.title} onClick=${click}>${children}${!allowed && html`<span class="sr-only"> (${reason})</span>`}</button>`;
}

/** A switch, on or off. @param {{on: boolean, label: string, change: () => any, role?: "viewer" | "operator" | "admin"}} given */
export function Switch({ on, label, change, role = "viewer" }) {
  useStore(session);
  const allowed = may(role);
  const reason = allowed ? undefined : `For the role ${role}; yours is ${session.get().current?.role ?? "none"}`;
  return html`<button type="button" class="switch" role="switch" aria-checked=${String(on)} aria-label=${label}
    disabled=${!allowed} title=${reason} onClick=${(/** @type {Event} */ event) => (event.stopPropagation(), change())}></button>`;
}
