"""Policies as ONNX models, one file for each agent."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax.envs.spaces import Box, Discrete, Simplex
from matd3_jax.errors import UserError
from matd3_jax.export.policy import Perceptron

OPSET, IR = 17, 8
"""Of 2022: read by every onnxruntime since 1.13."""


def check() -> None:
    """Raise UserError where the library is missing."""
    try:
        import onnx  # noqa: F401
    except ImportError:
        raise UserError("format=onnx needs onnx: pip install 'matd3_jax[export]'") from None


def model(policy: Perceptron, name: str, facts: Mapping[str, Any]) -> Any:
    """The `onnx.ModelProto` of one policy.

    Input "observation" [batch, size] float32; outputs "action" as the environment takes it, and of choices
    "probabilities". Its metadata have `facts` as JSON texts.
    """
    from onnx import TensorProto, helper, numpy_helper

    nodes: list[Any] = []
    constants: list[Any] = []
    space = policy.space

    def constant(name: str, value: Any, dtype: type = np.float32) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def node(kind: str, inputs: list[str], output: str | list[str], **attributes: Any) -> str:
        outputs = [output] if isinstance(output, str) else output
        nodes.append(helper.make_node(kind, inputs, outputs, name=f"{kind}_{len(nodes)}", **attributes))
        return outputs[0]

    x = "observation"
    if policy.mean is not None:
        x = node("Sub", [x, constant("mean", policy.mean)], "centered")
        x = node("Div", [x, constant("deviation", policy.deviation)], "scaled")
        ends = [constant("least", -policy.bound), constant("most", policy.bound)]
        x = node("Clip", [x, *ends], "normalized")
    last = len(policy.kernels) - 1
    for layer, (kernel, bias) in enumerate(zip(policy.kernels, policy.biases, strict=True)):
        parameters = [constant(f"kernel_{layer}", kernel), constant(f"bias_{layer}", bias)]
        x = node("Gemm", [x, *parameters], f"layer_{layer}")
        if layer < last:
            x = node("Relu", [x], f"hidden_{layer}")
    outputs: dict[str, tuple[int, list[str | int]]] = {}
    if isinstance(space, Box):
        half = (space.high - space.low) / 2
        if policy.slope == 1.0:
            x = node("Tanh", [x], "squashed")
            scale, shift = half, space.low + half
        else:
            x = node("Sigmoid", [x], "squashed")
            scale, shift = 2 * half, space.low
        x = node("Mul", [x, constant("scale", scale)], "stretched")
        node("Add", [x, constant("shift", shift)], "action")
        outputs["action"] = (TensorProto.FLOAT, ["batch", space.size])
    else:
        sizes = list(space.sizes)
        parts = [x] if len(sizes) == 1 else [f"logits_{k}" for k in range(len(sizes))]
        if len(sizes) > 1:
            node("Split", [x, constant("sizes", sizes, np.int64)], parts, axis=1)
        parts = [node("Softmax", [part], f"probabilities_{k}", axis=1) for k, part in enumerate(parts)]
        node("Concat", parts, "probabilities", axis=1)
        if isinstance(space, Simplex):
            node("Identity", ["probabilities"], "action")
            outputs["action"] = (TensorProto.FLOAT, ["batch", space.size])
        else:
            one = isinstance(space, Discrete)
            chosen = [node("ArgMax", [p], f"choice_{k}", axis=1, keepdims=int(not one)) for k, p in enumerate(parts)]
            joined = chosen[0] if len(chosen) == 1 else node("Concat", chosen, "choices", axis=1)
            node("Cast", [joined], "action", to=TensorProto.INT32)
            outputs["action"] = (TensorProto.INT32, ["batch"] if one else ["batch", len(sizes)])
        outputs["probabilities"] = (TensorProto.FLOAT, ["batch", space.size])
    size = policy.kernels[0].shape[0]
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", size])],
        [helper.make_tensor_value_info(key, kind, shape) for key, (kind, shape) in outputs.items()],
        constants,
    )
    made = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="matd3_jax"
    )
    helper.set_model_props(made, {key: json.dumps(value) for key, value in facts.items()})
    return made


def write(path: Path, policy: Perceptron, name: str, facts: Mapping[str, Any]) -> None:
    """Write the model of one policy, checked by onnx's own checker."""
    import onnx

    made = model(policy, name, facts)
    onnx.checker.check_model(made, full_check=True)
    path.write_bytes(made.SerializeToString())


def runner(path: Path) -> tuple[Any, str]:
    """(A function of observations [batch, size] to outputs by name, by what): onnxruntime, or where it is missing
    onnx's reference implementation."""
    try:
        import onnxruntime
    except ImportError:
        import onnx
        from onnx.reference import ReferenceEvaluator

        session, by = ReferenceEvaluator(str(path)), f"onnx {onnx.__version__}, reference implementation"
        names = session.output_names
    else:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        names, by = [output.name for output in session.get_outputs()], f"onnxruntime {onnxruntime.__version__}"
    return lambda x: dict(zip(names, session.run(None, {"observation": x}), strict=True)), by
