/** The console: the sign-in page, or the shell with the view that the URL names. */

import { Door, Lock } from "./door.js";
import { html, useEffect } from "./html.js";
import { start, stop } from "./live.js";
import { Nav } from "./nav.js";
import { startNotable, stopNotable } from "./notable.js";
import { Toasts, clearToasts } from "./parts/toast.js";
import { place } from "./router.js";
import { session } from "./session.js";
import { useShortcuts } from "./shortcuts.js";
import { useStore } from "./store.js";
import { Audit } from "./audit/view.js";
import { GraphView } from "./graph/view.js";
import { Hosts } from "./hosts/view.js";
import { Monitors } from "./monitors/view.js";
import { Now } from "./now/view.js";
import { PolicyView } from "./policy/view.js";
import { Recordings } from "./recordings/view.js";
import { NotLive } from "./standing.js";

const SHOWN = { now: Now, graph: GraphView, audit: Audit, policy: PolicyView, monitors: Monitors, hosts: Hosts, recordings: Recordings };

export function App() {
  const { current, locked, number } = useStore(session);
  return html`${!current && (locked ? html`<${Lock} key="lock" />` : html`<${Door} key="door" />`)}
    ${(current || locked) && html`<div key=${number} hidden=${!current}><${Shell} /></div>`}`;
}

function Shell() {
  const { view } = useStore(place);
  useEffect(() => {
    start({ graph: view === "graph" });
  }, [view]);
  useEffect(() => {
    startNotable();
    return () => {
      stop();
      stopNotable();
      clearToasts();
    };
  }, []);
  useEffect(() => {
    document.title = `${view[0].toUpperCase()}${view.slice(1)} · ROSRV`;
    scrollTo(0, 0);
  }, [view]);
  const help = useShortcuts();
  const View = SHOWN[/** @type {keyof typeof SHOWN} */ (view)];
  const skip = (/** @type {Event} */ event) => {
    event.preventDefault();
    document.getElementById("main")?.focus();
  };
  return html`<a class="skip" href="#main" onClick=${skip}>Skip to the view</a>
    <div class="shell"><${Nav} />
      <main class="main" id="main" tabindex="-1"><${NotLive} /><${View} /></main></div>
    <${Toasts} />${help}`;
}
