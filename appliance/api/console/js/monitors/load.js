/** Load a new specification, from a file or the editor, with its message definitions. */

import { html, useState } from "../html.js";
import { attempt } from "../parts/attempt.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Editor } from "../parts/editor.js";
import { Check, Field } from "../parts/field.js";
import { Given } from "../parts/given.js";
import { Signature } from "../parts/signature.js";
import { done } from "../parts/toast.js";
import { useSpecification } from "./draft.js";
import { Outcome } from "./report.js";

const EXAMPLE = `// The purpose of the monitor, in a sentence.

example() {
    int count = 0;

    event message(string text) /chatter std_msgs/String '{data:text}' {
        count++;
    }
}
`;

/** @param {{etag: string, files: string[], signed: boolean, close: () => void, loaded: () => Promise<void>}} given `signed`: it must be */
export function LoadSpecification({ etag, files, signed, close, loaded }) {
  const [name, setName] = useState("example.rv");
  const [note, setNote] = useState("");
  const [definitions, setDefinitions] = useState(/** @type {Record<string, string>} */ ({}));
  const [signatures, setSignatures] = useState(/** @type {Record<string, string>} */ ({})); // by file name, without folders
  const [hold, setHold] = useState(false);
  const [line, setLine] = useState(/** @type {any} */ (null));
  const draft = useSpecification(EXAMPLE);
  const send = (/** @type {boolean} */ dry) => {
    const names = [name, ...Object.keys(definitions)].map((one) => [one, signatures[one.split("/").at(-1) ?? ""] ?? ""]);
    return draft.send({ [name]: draft.text }, { dry, note, hold, definitions, signatures: Object.fromEntries(names), match: dry ? undefined : etag });
  };
  const load = async () => {
    const body = await send(false);
    if (!body) return;
    draft.write(EXAMPLE);
    done(`Revision ${body.revision} of the specifications is in force`, [...body.added, ...body.changed].join(", "));
    await loaded();
    close();
  };
  const choose = (/** @type {any} */ event) => attempt(async () => {
    const read = await Promise.all([...event.target.files].map(async (/** @type {File} */ one) => [one.name, one.webkitRelativePath, await one.text()]));
    for (const [file, , text] of read) {
      if (file.endsWith(".rv")) {
        setName(file);
        draft.write(text);
      }
    }
    const beside = read.filter(([file]) => file.endsWith(".sig")).map(([file, , text]) => [file.slice(0, -4), text]);
    setSignatures({ ...signatures, ...Object.fromEntries(beside) });
    const more = read.filter(([file]) => /\.(msg|srv)$/.test(file)).map(([file, , text]) => [`custom_msgs/${file}`, text]);
    if (more.length) setDefinitions({ ...definitions, ...Object.fromEntries(more) });
  });
  const rename = (/** @type {string} */ old, /** @type {string} */ next) => setDefinitions(Object.fromEntries(Object.entries(definitions).map(([key, text]) => [key === old ? next : key, text])));
  const foot = html`<button class="button" onClick=${close}>Not yet</button><${Button} role="operator" onClick=${() => send(true)}>Dry run</${Button}><${Button} role="admin" tone="primary" onClick=${load}>${files.includes(name) ? "Replace the file" : "Load"}</${Button}>`;
  return html`<${Dialog} wide title="Load a specification" close=${close} foot=${foot}>
    <div class="form-grid"><${Field} label="File name" mono value=${name} set=${setName} hint=${files.includes(name) ? "replaces the file of this name" : "a new file"} /><${Field} label="Comment" value=${note} set=${setNote} placeholder="Reason or ticket number" maxlength="200" hint="kept with the revision" />
      <div class="field"><label for="spec-files">Take it from files</label><input id="spec-files" class="input" type="file" multiple accept=".rv,.msg,.srv,.sig" onChange=${choose} /><span class="hint">.rv, and the .msg or .srv that ROS does not ship${signed && ", each with its .sig"}</span></div></div>
    <${Signature} asked=${signed} value=${signatures[name] ?? ""} set=${(/** @type {string} */ next) => setSignatures({ ...signatures, [name]: next })} />
    ${Object.keys(definitions).length > 0 && html`<div class="form-grid">${Object.keys(definitions).map((one, index) => html`<${Field} key=${index} label="Definition, as package/Type.msg" mono value=${one} set=${(/** @type {string} */ next) => rename(one, next)} hint=${html`${definitions[one].length} characters; ends up as <${Given} value=${one} />`} />`)}</div>`}
    <${Check} label="Load even if monitors then hold topics with traffic, until they are resumed" on=${hold} set=${setHold} />
    <${Outcome} ...${draft} pick=${(/** @type {any} */ one) => setLine({ number: one.line, column: one.column, count: (line?.count ?? 0) + 1 })} />
    <${Editor} label="Specification" language="rv" value=${draft.text} change=${draft.write} findings=${draft.findings.filter((one) => one.file === name)} line=${line} dry=${() => send(true)} height="38vh" /></${Dialog}>`;
}
