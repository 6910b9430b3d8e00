/** The console: the sign-in page, or the shell with the view that the URL names. */

import { entitle } from "./attention.js";
import { Door, Lock } from "./door.js";
import { html, useEffect } from "./html.js";
import { start, stop } from "./live.js";
import { Nav } from "./nav.js";
import { startNotable, stopNotable } from "./notable.js";
import { FeatureParts } from "./parts/features.js";
import { useNames } from "./parts/host.js";
import { Toasts, clearToasts } from "./parts/toast.js";
import { passive } from "./passive.js";
import { place } from "./router.js";
import { Search } from "./search/search.js";
import { session } from "./session.js";
import { useShortcuts } from "./shortcuts.js";
import { useStore } from "./store.js";
import { NotLive } from "./standing.js";
import { VIEWS } from "./views.js";

export function App() {
  const { current, locked, number } = useStore(session);
  const standby = useStore(passive, (one) => one.active !== "") && current !== null;
  return html`${standby && html`<${FeatureParts} place="standby" />`}${!current && (locked ? html`<${Lock} key="lock" />` : html`<${Door} key="door" />`)}
    ${(current || locked) && html`<div key=${number} hidden=${!current || standby}><${Shell} standby=${standby} /></div>`}`;
}

/** The navigation and the view. A standby has nothing to follow: unsaved work is kept until it is active again. @param {{standby: boolean}} given */
function Shell({ standby }) {
  const { view } = useStore(place);
  const { title, View } = VIEWS.find(({ name }) => name === view) ?? VIEWS[0];
  useEffect(() => {
    if (!standby) start({ graph: view === "graph" });
  }, [view, standby]);
  useEffect(() => {
    if (standby) return undefined;
    startNotable();
    return () => {
      stop();
      stopNotable();
      clearToasts();
    };
  }, [standby]);
  useEffect(() => {
    if (standby) return;
    entitle(title);
    scrollTo(0, 0);
  }, [view, standby]);
  useNames();
  const help = useShortcuts();
  const skip = (/** @type {Event} */ event) => {
    event.preventDefault();
    document.getElementById("main")?.focus();
  };
  return html`<a class="skip" href="#main" onClick=${skip}>Skip to the view</a>
    <div class="shell"><${Nav} />
      <main class="main" id="main" tabindex="-1"><${NotLive} /><${FeatureParts} place="banner" /><${View} /></main></div>
    <${Toasts} />${help}<${Search} />`;
}
