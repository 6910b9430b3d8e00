/** Navigation between views, and the current user. */

import { html, useState } from "./html.js";
import { live } from "./live.js";
import { Moment } from "./moments.js";
import { Dialog } from "./parts/dialog.js";
import { Given } from "./parts/given.js";
import { Icon, Mark } from "./parts/icon.js";
import { Link, place } from "./router.js";
import { ROBOT, session } from "./session.js";
import { signOut } from "./sign-on.js";
import { Pulse } from "./standing.js";
import { openSearch } from "./search/search.js";
import { listKeys } from "./shortcuts.js";
import { useStore } from "./store.js";
import { switchTheme, theme } from "./theme.js";
import { VIEWS } from "./views.js";

const RIGHTS = {
  viewer: "reads everything, except the content of messages.",
  investigator: "reads everything, also the messages of recordings.",
  operator: "reads everything, except the messages of recordings. Approves and refuses calls, hands over command groups, makes tickets for doors, blocks hosts, switches monitors that were approved before, and keeps or rolls back the policy.",
  admin: "does what an operator does. Also loads the policy and specifications, adds and removes guards, doors and hosts, and ends tokens.",
};

export function Nav() {
  const [asked, setAsked] = useState(false);
  const { view } = useStore(place);
  const alarms = useStore(live, (one) => one.alarms.filter((alarm) => alarm.severity === "alarm").length);
  const version = useStore(live, (one) => one.status?.version ?? "");
  const { current } = useStore(session);
  return html`<header class="side">
    <div class="brand"><${Mark} /><div><div class="brand-name">${ROBOT || "ROSRV"}</div><div class="brand-sub">${[ROBOT ? "ROSRV" : "Appliance", version].filter(Boolean).join(" ")}</div></div></div>
    <nav class="nav" aria-label="Views"><ul>${VIEWS.map(({ name, title }, index) => html`<li key=${name}>
      <${Link} to=${`/console/${name}`} class="fades" aria-current=${name === view ? "page" : undefined} aria-keyshortcuts=${String(index + 1)}>
        <${Icon} name=${name} /><span>${title}</span>
        ${name === "now" && alarms > 0 && html`<span class="count" title="open alarms">${alarms}<span class="sr-only"> open alarms</span></span>`}
        <span class="key" aria-hidden="true">${index + 1}</span>
      </${Link}></li>`)}</ul></nav>
    <div class="side-foot"><${Pulse} />
      <button class="who" title="What you may do" onClick=${() => setAsked(true)}><span class="who-name"><${Given} value=${current?.name} most=${40} /></span><span class="muted small" data-role=${current?.role}>${current?.role}</span></button>
      <div class="side-buttons"><button class="button plain" onClick=${openSearch} aria-label="Search" title="Search" aria-keyshortcuts="/"><${Icon} name="search" /></button><${ThemeSwitch} />
        <button class="button plain" onClick=${listKeys} aria-label="Keys" title="Keys" aria-keyshortcuts="?"><${Icon} name="keyboard" /></button>
        <button class="button plain" onClick=${signOut} aria-label="Sign out" title="Sign out"><${Icon} name="out" /></button></div>
    </div>${asked && current && html`<${Dialog} title="What you may do" close=${() => setAsked(false)}>
      <p><${Given} value=${current.name} most=${40} /> has the role <strong>${current.role}</strong> until <${Moment} at=${current.expires} always="day" />. This role ${RIGHTS[current.role]}</p>
      <p class="muted">Buttons that need another role are grey, and name it.</p></${Dialog}>`}</header>`;
}

function ThemeSwitch() {
  const dark = useStore(theme) === "dark";
  const word = dark ? "Use the light theme" : "Use the dark theme";
  return html`<button class="button plain" onClick=${switchTheme} aria-label=${word} title=${word} aria-keyshortcuts="t"><${Icon} name=${dark ? "sun" : "moon"} /></button>`;
}
