/** The text for a part of the console that cannot be loaded, because an upgrade replaced the files of an open page. */
export const OUTDATED = "A part of the page could not be loaded. Check that the appliance runs. If it was upgraded, reload the page.";
