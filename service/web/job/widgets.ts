// What draws with WebGL and canvases: in a file of its own, so that lists and uploads do not wait for it.
export { Curves } from "../../../biresnerf/viewer/Curves";
export { ImageCompare } from "../../../biresnerf/viewer/ImageCompare";
export { ImageTable } from "../../../biresnerf/viewer/ImageTable";
export { SceneView } from "../../../biresnerf/viewer/SceneView";
export { VerdictSentence } from "../../../biresnerf/viewer/VerdictSentence";
