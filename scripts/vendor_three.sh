#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Makes pcgraph/viewer/three.js anew: the parts of three.js that the viewer uses, in one file. Needs npm and a network.
# The same versions give the same bytes; sha256sum compares them with the file that is here.
set -eu
THREE=0.187.0
ESBUILD=0.28.2
viewer=$(cd "$(dirname "$0")/../pcgraph/viewer" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
echo '{"private": true}' > package.json
npm install --silent --no-audit --no-fund --no-save "three@$THREE" "esbuild@$ESBUILD"
cat > entry.js <<'END'
export {
  AlwaysDepth, BufferAttribute, BufferGeometry, Camera, DataTexture, DepthTexture, DoubleSide, GLSL3, Matrix4, Mesh, NearestFilter,
  OrthographicCamera, PerspectiveCamera, Points, RawShaderMaterial, Scene, UnsignedIntType, Vector3, WebGLRenderer, WebGLRenderTarget,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
END
node_modules/.bin/esbuild entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=none \
  --charset=utf8 --target=es2020 --log-level=warning --outfile=three.js
cp node_modules/three/LICENSE "$viewer/three.LICENSE.txt"
{ echo "/* three.js $THREE, MIT: see three.LICENSE.txt; made by scripts/vendor_three.sh */"; cat three.js; } > "$viewer/three.js"
sha256sum "$viewer/three.js"
