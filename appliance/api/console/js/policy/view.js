/** Policy: edit, check, explain, test, compare, load and roll back. */

import { html, useEffect, useState } from "../html.js";
import { live as appliance } from "../live.js";
import { lasting, Moment } from "../moments.js";
import { counted } from "../numbers.js";
import { useApplianceTime } from "../parts/ago.js";
import { attempt } from "../parts/attempt.js";
import { Badge } from "../parts/badge.js";
import { Button } from "../parts/button.js";
import { Difference } from "../parts/difference.js";
import { Editor } from "../parts/editor.js";
import { By, Given } from "../parts/given.js";
import { Icon } from "../parts/icon.js";
import { Failure, Loading, Notice } from "../parts/notice.js";
import { Tabs } from "../parts/tabs.js";
import { done } from "../parts/toast.js";
import { go, place } from "../router.js";
import { may } from "../session.js";
import { useStore } from "../store.js";
import { Check } from "./check.js";
import { complete } from "./complete.js";
import { change, check, discard, draft, dryRun, look, rebase, write } from "./draft.js";
import { Explain } from "./explain.js";
import { LoadDialog } from "./load.js";
import { Revisions, RevisionText } from "./revisions.js";
import { Tests } from "./tests.js";
import { Uses } from "./uses.js";

const PAUSE = 1200; // milliseconds between the last key and the check of the text
const TABS = /** @type {[string, string][]} */ ([["check", "Check"], ["diff", "Diff"], ["explain", "Explain"], ["tests", "Tests"], ["uses", "Uses"], ["revisions", "Revisions"]]);

export function PolicyView() {
  const { live, text, base, findings, errors, error } = useStore(draft);
  const { query } = useStore(place);
  const revision = useStore(appliance, (one) => one.status?.policy.revision ?? null);
  const confirming = useStore(appliance, (one) => one.status?.policy.confirm_by ?? null);
  const [tab, setTab] = useState(TABS.some(([name]) => name === query.get("tab")) ? /** @type {string} */ (query.get("tab")) : "check");
  const [line, setLine] = useState(/** @type {any} */ (null));
  const [loading, setLoading] = useState(false);
  const changed = text !== base;

  useEffect(() => {
    look();
  }, [revision, confirming]);
  useEffect(() => {
    const wanted = query.get("tab");
    if (wanted && TABS.some(([name]) => name === wanted)) setTab(wanted);
    if (query.get("line") && !older(query, live)) setLine({ number: Number(query.get("line")), count: 0 });
  }, [query, live !== null]);
  useEffect(() => {
    if (!changed) return undefined;
    const controller = new AbortController();
    const timer = setTimeout(() => check(controller.signal), PAUSE);
    return () => (clearTimeout(timer), controller.abort());
  }, [text, changed]);

  if (!live) return html`<div class="head"><h1>Policy</h1></div>${error ? html`<${Failure} error=${error} retry=${look} />` : html`<section class="panel"><${Loading} rows=${10} /></section>`}`;
  const pick = (/** @type {any} */ finding) => setLine({ number: finding.line, column: finding.column, count: (line?.count ?? 0) + 1 });
  const dry = async () => {
    setTab("check");
    await dryRun().catch(() => {});
  };
  const stale = changed && draft.get().etag !== `"${live.revision}"`;
  return html`<div class="head"><h1>Policy</h1><span class="head-sub">revision ${live.revision} in force since <${Moment} at=${live.loaded} />, <${By} who=${live.who} />${live.note && html`: <${Given} value=${live.note} most=${80} />`}</span></div>
    <${Standing} live=${live} stale=${stale} showDiff=${() => setTab("diff")} />
    <div class="policy-grid">
      <section class="panel" aria-label="Text of the policy">
        <div class="panel-head">${changed ? html`<${Badge} word="changed here, not loaded" tone="warn" />` : html`<${Badge} word="as in force" tone="allow" />`}<span class="muted small path"><${Given} value=${live.policy_file} most=${120} mono /></span>
          <span class="end">${changed && html`<button class="button small plain" onClick=${discard}>Discard</button>`}
            <${Button} small role="operator" aria-keyshortcuts="d" onClick=${dry} title="Check, test, and list what would be decided differently (Ctrl S)">Dry run</${Button}>
            ${errors > 0 && html`<span id="unloadable"><${Badge} word=${counted(errors, "error")} tone="deny" /></span>`}
            <${Button} small role="admin" tone="primary" disabled=${!changed || errors > 0} why=${errors > 0 ? `The text has ${counted(errors, "error")}` : "The text is the policy in force"} aria-keyshortcuts="l" aria-describedby=${errors > 0 ? "unloadable" : undefined} onClick=${() => setLoading(true)}>Load</${Button}></span></div>
        <${Editor} label="Access policy" language="policy" value=${text} change=${write} findings=${findings.filter((one) => !one.file.includes(".tests."))} line=${line} dry=${() => may("operator") && dry()} keys="i" complete=${complete} height="calc(100dvh - 250px)" />
      </section>
      <section class="panel" aria-label="About the policy"><${Tabs} label="About the policy" tabs=${TABS} chosen=${tab} choose=${setTab}>
        ${tab === "check" && html`<${Check} pick=${pick} />`}
        ${tab === "diff" && html`<div class="panel-body"><${Difference} old=${live.text} now=${text} same="The text is the policy in force." /></div>`}
        ${tab === "explain" && html`<${Explain} key=${query.toString()} query=${query} pick=${pick} />`}
        ${tab === "tests" && html`<${Tests} />`}${tab === "uses" && html`<${Uses} pick=${changed ? null : pick} />`}${tab === "revisions" && html`<${Revisions} />`}</${Tabs}></section></div>
    ${loading && html`<${LoadDialog} close=${() => setLoading(false)} />`}
    ${older(query, live) && html`<${RevisionText} revision=${Number(query.get("revision"))} line=${Number(query.get("line")) || 1} close=${() => go("/console/policy")} />`}`;
}

/** Whether the URL names a revision that is not in force now. */
function older(/** @type {URLSearchParams} */ query, /** @type {any} */ live) {
  const named = Number(query.get("revision"));
  return live !== null && named > 0 && named !== live.revision;
}

function Standing(/** @type {{live: any, stale: boolean, showDiff: () => void}} */ { live, stale, showDiff }) {
  const now = useApplianceTime();
  const act = (/** @type {string} */ what, /** @type {any} */ json, /** @type {string} */ said) => () => attempt(async () => {
    done(said, `Revision ${(await change(what, json)).revision} is in force.`);
  });
  return html`<div class="standing">
    ${live.confirm_by && html`<${Notice} tone="warn" title=${`Revision ${live.revision} rolls back ${now === null ? "soon" : `in ${lasting(live.confirm_by - now)}`} unless confirmed`}>
      <div class="row"><${Button} small role="operator" tone="primary" onClick=${act("confirm", undefined, "The policy is kept")}>Keep it</${Button}><${Button} small role="operator" onClick=${act("rollback", {}, "The previous policy is back in force")}>Roll back now</${Button}></div></${Notice}>`}
    ${live.differs_from_file && html`<${Notice} title="The policy in force differs from the file"><div class="row"><span><${Given} value=${live.policy_file} mono most=${120} /> is not read again until you reload it.</span><${Button} small role="operator" onClick=${act("reload", undefined, "The file was read again")}><${Icon} name="again" size=${14} />Reload from the file</${Button}></div></${Notice}>`}
    ${live.warnings.length > 0 && html`<details class="notice warn"><summary>${live.warnings.length} ${live.warnings.length === 1 ? "warning" : "warnings"} about the policy in force</summary><ul class="plain-list">${live.warnings.map((/** @type {string} */ one) => html`<li key=${one}><${Given} value=${one} most=${400} /></li>`)}</ul></details>`}
    ${stale && html`<${Notice} tone="warn" title=${`Revision ${live.revision} came into force while you wrote`}><div class="row"><span>Look at the difference; then keep your text and load it over that revision, or discard it.</span><button class="button small" onClick=${() => (rebase(), showDiff())}>Keep my text, show the difference</button></div></${Notice}>`}</div>`;
}
