/** The components of features. The API replaces this list by one from the table of features (`console.py`). */

/** @type {{place: string, title: string, Part: any}[]} */
export const PARTS = [];
