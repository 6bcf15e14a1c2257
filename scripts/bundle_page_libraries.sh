#!/usr/bin/env bash
# Makes the JavaScript libraries of a run's page anew: cpdeform/report/page/static/libraries.min.js and the licences beside it.
# Needs node and npm, and the npm registry; nobody needs either to use or to test cpdeform.
set -euo pipefail
static="$(cd "$(dirname "$0")/../cpdeform/report/page/static" && pwd)"
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
cp "$static/libraries.js" "$folder/"
cd "$folder"
npm init --yes >/dev/null
npm install --silent three@0.187.0 uplot@1.6.32 esbuild@0.28.2
npx esbuild libraries.js --bundle --minify --format=iife --global-name=libraries --legal-comments=inline --outfile="$static/libraries.min.js"
cp node_modules/uplot/dist/uPlot.min.css "$static/uplot.min.css"
for name in three uplot; do cp "node_modules/$name/LICENSE" "$static/licences/$name.txt"; done
