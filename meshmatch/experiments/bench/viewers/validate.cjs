// node validate.cjs FOLDER FILE ...: runs Khronos' validator, from npm's folder of modules, on each file; prints JSON lines.
const fs = require("fs");
const path = require("path");
const [modules, ...files] = process.argv.slice(2);
const validator = require(path.join(modules, "gltf-validator"));

async function main() {
  for (const file of files) {
    const found = { file, version: validator.version(), issues: [] };
    try {
      const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {
        uri: file,
        maxIssues: 1000,
        externalResourceFunction: (name) =>
          fs.promises.readFile(path.resolve(path.dirname(file), decodeURIComponent(name))).then((data) => new Uint8Array(data)),
      });
      found.issues = report.issues.messages.map(({ severity, code, message, pointer }) => ({ severity, code, message, pointer }));
    } catch (error) {
      found.error = String(error).split("\n")[0];
    }
    console.log(JSON.stringify(found));
  }
}

main();
