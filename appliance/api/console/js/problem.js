/** The error of a request, as the appliance reported it (problem details, RFC 9457). */

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
    this.active = body.active ?? "";
  }

  /** The kind of the problem: the end of its type. */
  get kind() {
    return this.type.split(":").pop();
  }

  /** Whether the same request may succeed later. */
  get passing() {
    return this.status === 0 || this.status === 429 || this.status >= 500;
  }
}

/** A short heading for an error. @param {unknown} error */
export function headline(error) {
  if (!(error instanceof Problem)) return "Defect in this page";
  const known = {
    0: "The appliance does not answer",
    401: "Token rejected",
    403: error.kind === "not-for-this-role" ? "Not for this role" : error.title || "Refused",
    404: "Not found",
    412: "Changed by someone else",
    413: "Too large",
    422: "Rejected",
    428: "Load the page again first",
    429: "Too many requests",
    503: "Temporarily unavailable",
  };
  return known[/** @type {keyof typeof known} */ (error.status)] ?? `Failed (${error.status})`;
}
