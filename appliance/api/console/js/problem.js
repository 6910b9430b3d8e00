/** What went wrong with a request, as the appliance said it (problem details, RFC 9457). */

/** @typedef {{file: string, line: number, column: number, severity: string, text: string}} Finding */

export class Problem extends Error {
  /** @param {number} status @param {Record<string, any>} body @param {number | null} [retryAfter] seconds */
  constructor(status, body, retryAfter = null) {
    super(body.detail || body.title || `status ${status}`);
    this.status = status;
    this.type = body.type ?? "";
    this.title = body.title ?? "";
    /** @type {Finding[]} */
    this.findings = Array.isArray(body.findings) ? body.findings : [];
    /** @type {{where: string, text: string}[]} */
    this.errors = Array.isArray(body.errors) ? body.errors : [];
    this.retryAfter = retryAfter;
  }

  /** Whether trying the same again later may help. */
  get passing() {
    return this.status === 0 || this.status === 429 || this.status >= 500;
  }
}

/** A short heading for what happened. @param {unknown} error */
export function headline(error) {
  if (!(error instanceof Problem)) return "The page has a defect";
  const known = {
    0: "The appliance does not answer",
    401: "The token is not accepted",
    403: "Not for this role",
    404: "There is no such thing",
    412: "Somebody else was quicker",
    413: "Too large",
    422: "Refused",
    428: "Load the page again first",
    429: "Too many requests",
    503: "Not available now",
  };
  return known[/** @type {keyof typeof known} */ (error.status)] ?? `Failed (${error.status})`;
}
