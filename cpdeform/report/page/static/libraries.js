// What the page uses of its libraries; scripts/bundle_page_libraries.sh makes libraries.min.js of it.
export {
  BufferAttribute, BufferGeometry, DataTexture, Group, LineBasicMaterial, LineLoop, LinearFilter, Mesh, MeshBasicMaterial,
  PerspectiveCamera, PlaneGeometry, Points, Quaternion, RGBAFormat, ShaderMaterial, Scene, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { toCreasedNormals } from "three/addons/utils/BufferGeometryUtils.js";
export { default as uPlot } from "uplot";
