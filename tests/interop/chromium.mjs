// Unpacks Chromium and its libraries from the npm package into the folder TMPDIR and prints the program's path.
import { fileURLToPath } from "node:url";
import chromium, { inflate } from "@sparticuz/chromium";

const libraries = new URL("node_modules/@sparticuz/chromium/bin/al2023.tar.br", import.meta.url);
await inflate(fileURLToPath(libraries));
console.log(await chromium.executablePath());
