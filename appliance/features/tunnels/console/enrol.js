/** Enrol a host: with a one-time token and its own key, or with a kit. */

import { html, useState } from "#console/html.js";
import { save } from "#console/audit/proof.js";
import { Moment } from "#console/moments.js";
import { useAttempt } from "#console/parts/attempt.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Icon } from "#console/parts/icon.js";
import { Failure, Notice } from "#console/parts/notice.js";
import { done } from "#console/parts/toast.js";
import { send } from "#console/rest.js";

const HOW = /** @type {[string, string][]} */ ([["token", "One-time token: the host creates its own key"], ["kit", "Kit: an archive with a private key, to copy to the host"]]);
const LASTS = /** @type {[string, string][]} */ ([["900", "15 minutes"], ["3600", "1 hour"], ["86400", "1 day"], ["604800", "7 days"]]);

/** @param {{host?: any, etag: string, close: () => void, after: () => void}} given `host`: one that is there already */
export function Enrol({ host, etag, close, after }) {
  const [form, setForm] = useState({ name: host?.name ?? "", how: "token", endpoint: reachedAt(location.hostname), days: "90", token_seconds: "3600", open: "", address: "" });
  const [error, attemptToEnrol] = useAttempt();
  const [made, setMade] = useState(/** @type {any} */ (null));
  const set = (/** @type {string} */ name) => (/** @type {string} */ value) => setForm({ ...form, [name]: value });
  const token = form.how === "token";
  const go = () => attemptToEnrol(async () => {
    const response = await request(form, host, etag);
    if (token) setMade(await response.json());
    else {
      save(await response.blob(), `rosrv-${form.name}.tar.gz`);
      done(`The kit of ${form.name} is saved`, "It contains a private key: keep it secret, and delete it afterwards.");
      close();
    }
    after();
  });
  if (made) return html`<${Made} made=${made} close=${close} />`;
  const title = host ? `A new ${host.enrolled === null ? "token" : "certificate"} for ${host.name}` : "Enrol a host";
  const foot = html`<button class="button" onClick=${close}>Not yet</button><${Button} role="admin" tone="primary" disabled=${!form.name} why="Enter a name" onClick=${go}>${token ? "Create the token" : "Create the kit"}</${Button}>`;
  return html`<${Dialog} title=${title} close=${close} foot=${foot}><${Failure} error=${error} />
    ${!host && html`<${Field} label="Name" mono value=${form.name} set=${set("name")} placeholder="ocu-1" hint="host:NAME in the policy" />`}
    <${Field} label="How" value=${form.how} set=${set("how")} options=${HOW} />
    ${host?.enrolled && !token && html`<${Notice} tone="warn">The old certificate is revoked and its tunnel closed at once.</${Notice}>`}
    <div class="form-grid"><${Field} label="Address of the appliance, as the host sees it" mono value=${form.endpoint} set=${set("endpoint")} placeholder="what the appliance finds" hint="UDP 500 and 4500 must be reachable" /><${Field} label="Certificate valid for (days)" type="number" min="1" max="398" value=${form.days} set=${set("days")} /></div>
    <div class="form-grid">${token && html`<${Field} label="Token valid for" value=${form.token_seconds} set=${set("token_seconds")} options=${LASTS} />`}<${Field} label="Services to keep open on the host" mono value=${form.open} set=${set("open")} placeholder="tcp/22" hint="all others are closed to all but the appliance" />
      ${!host && html`<${Field} label="Virtual address" mono value=${form.address} set=${set("address")} placeholder="the next free one" />`}</div></${Dialog}>`;
}

/** Return the browser's address for the appliance, which hosts also use; empty if it is a loopback address. */
function reachedAt(/** @type {string} */ hostname) {
  const name = hostname.replace(/^\[|\]$/g, "");
  return name === "localhost" || name === "::1" || name.startsWith("127.") ? "" : name;
}

function request(/** @type {Record<string, string>} */ form, /** @type {any} */ host, /** @type {string} */ etag) {
  const token = form.how === "token";
  const common = { endpoint: form.endpoint || null, days: Number(form.days), open: form.open.split(/[\s,]+/).filter(Boolean) };
  const timed = token ? { token_seconds: Number(form.token_seconds) } : {};
  if (host) return send("POST", `/v1/hosts/${encodeURIComponent(host.name)}/${token ? "token" : "kit"}`, { json: { ...common, ...timed }, match: etag });
  return send("POST", "/v1/hosts", { json: { ...common, ...timed, name: form.name, how: form.how, address: form.address || null }, match: etag });
}

/** The token, which is shown once. */
function Made(/** @type {{made: any, close: () => void}} */ { made, close }) {
  const script = () => save(new Blob([made.script], { type: "text/x-shellscript" }), `rosrv-${made.name}-join.sh`);
  return html`<${Dialog} title=${`${made.name} may enrol itself`} close=${close} foot=${html`<button class="button primary" onClick=${close}>Done</button>`}>
    <${Notice} tone="warn" title="Shown this once">The token is not stored. It can be used once, until <${Moment} at=${made.expires} />.</${Notice}>
    <dl class="facts"><dt>Host</dt><dd><${Given} value=${made.name} mono />, <${Given} value=${made.address} mono /></dd><dt>Token</dt><dd data-token><${Given} value=${made.token} mono most=${200} /></dd><dt>For</dt><dd><${Given} value=${made.url} mono most=${200} />${made.endpoint_reason && html` <${Given} value=${`(${made.endpoint_reason})`} />`}</dd></dl>
    <p>Copy the script to the host and run it as root. It creates the key, enrols the host, starts the tunnel and checks it.</p>
    <pre class="bytes">sudo sh rosrv-${made.name}-join.sh</pre>
    <div class="row"><button class="button" onClick=${script}><${Icon} name="down" size=${16} />Download the script</button></div></${Dialog}>`;
}
