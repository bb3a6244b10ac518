// Files in and out: what is dropped on the page or chosen, and what is downloaded.

import { byId, h } from "misstep/dom.js";
import { problemOf, upload } from "misstep/link.js";

const SOON = 1200; // ms, after which one is told that a download is being made

export function startUploads(tell) {
  const add = async (files) => {
    for (const file of files) {
      try {
        const count = await upload(file);
        tell(`${count} recording${count === 1 ? "" : "s"} added from ${file.name}`);
      } catch (error) {
        tell(`${file.name} was not added: ${error.message === "Failed to fetch" ? "the server refused it or is gone" : error.message}`);
      }
    }
  };
  byId("upload").addEventListener("click", () => byId("file").click());
  byId("file").addEventListener("change", (event) => { add([...event.target.files]); event.target.value = ""; });
  addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("dropping"); });
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) document.body.classList.remove("dropping"); });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    add([...event.dataTransfer.files]);
  });
}

export async function download(address, tell) {
  const soon = setTimeout(() => tell("The download is being made; what is being learned comes first"), SOON);
  try {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(await problemOf(answer));
    const name = /filename\*=utf-8''(.+)$/.exec(answer.headers.get("content-disposition"))[1];
    const url = URL.createObjectURL(await answer.blob());
    const anchor = h("a", { href: url, download: decodeURIComponent(name) });
    document.body.append(anchor);
    anchor.click();
    anchor.remove();
    setTimeout(() => URL.revokeObjectURL(url), 60000);
  } catch (error) {
    tell(`the download failed: ${error.message}`);
  } finally {
    clearTimeout(soon);
  }
}
