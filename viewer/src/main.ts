// Starts the page: reads the scenes, of a server or of the file itself, and shows them.

import { App } from "./app";
import { readContainer } from "./container";
import { FileAnswers } from "./file_answers";
import { hasWebGL } from "./pane";
import { Scene } from "./scene";
import { ServerAnswers, sceneOfServer } from "./server_answers";
import type { Answers, FileMeta, PageSettings } from "./types";

const root = document.getElementById("app") as HTMLElement;

function say(message: string): void {
  const line = document.createElement("p");
  line.className = "message";
  line.setAttribute("role", "status");
  line.textContent = message;
  root.replaceChildren(line);
}

async function sceneOfFile(number: number): Promise<{ scene: Scene; answers: Answers }> {
  const element = document.getElementById(`scene-${number}`);
  const packed = Uint8Array.from(atob(element?.textContent ?? ""), (letter) => letter.charCodeAt(0));
  // The text is tens of megabytes.
  element?.remove();
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const container = readContainer<FileMeta>(await new Response(stream).arrayBuffer());
  const scene = new Scene(container);
  return { scene, answers: new FileAnswers(container, scene) };
}

async function sceneOf(settings: PageSettings, number: number): Promise<{ scene: Scene; answers: Answers }> {
  if (settings.kind === "file") return sceneOfFile(number);
  const scene = await sceneOfServer(number);
  return { scene, answers: new ServerAnswers(number, scene) };
}

async function start(): Promise<void> {
  const settings = JSON.parse(document.getElementById("settings")?.textContent ?? "{}") as PageSettings;
  if (!hasWebGL()) {
    say("This page draws with WebGL 2, which this browser does not offer here. Another browser, or hardware acceleration switched on in its settings, shows the scene.");
    document.body.dataset.state = "failed";
    return;
  }
  say("Loading the scene …");
  const scenes = [];
  for (let number = 0; number < settings.scenes; number++) scenes.push(await sceneOf(settings, number));
  const app = new App(root, settings, scenes);
  await app.start();
  Object.assign(globalThis, { gsencoderViewer: app });
  document.body.dataset.state = "ready";
}

start().catch((error: unknown) => {
  say(`The scene cannot be shown: ${error instanceof Error ? error.message : String(error)}`);
  document.body.dataset.state = "failed";
});
