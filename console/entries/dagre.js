// Where nodes and topics stand in the drawing of the graph.
export { Graph, layout } from "@dagrejs/dagre";
