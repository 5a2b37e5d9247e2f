// The widgets that need WebGL or a canvas: a bundle of its own, so that lists and uploads load without it.
export { Curves } from "../../../biresnerf/viewer/widgets/curves";
export { ImageCompare } from "../../../biresnerf/viewer/widgets/image_compare";
export { ImageTable } from "../../../biresnerf/viewer/widgets/image_table";
export { ResultSummary } from "../../../biresnerf/viewer/widgets/result_summary";
export { SceneView } from "../../../biresnerf/viewer/scene/scene_view";
export { ResultView } from "../../../biresnerf/viewer/result_view";
