# SPDX-License-Identifier: Apache-2.0
"""Small segmentation models, made by the tests themselves."""
from __future__ import annotations

import numpy as np
import pytest


def pixel_model(path, threshold=30.0, classes=65, vehicle=64, size=('h', 'w'), labels=False,
                batch=1, planes=3, stride=1):
    """Save a model for which what is darker than the threshold (grey level) is the vehicle.

    It takes batch x planes x size; stride: how much smaller its output is.
    """
    weights = np.zeros((classes, planes, 1, 1), np.float32)
    bias = np.full((classes, 1), -100.0, np.float32)
    mean, spread = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    # undoes the normalisation: the sum of the planes in grey levels
    weights[vehicle] = -np.resize(255 * spread, (planes, 1, 1))
    bias[vehicle] = planes * threshold - np.resize(255 * mean, planes).sum()
    bias[0] = 0.0
    helper, kind = _onnx()
    nodes = [helper.make_node('Conv', ['picture', 'weights', 'bias'], ['logits'],
                              strides=[stride, stride])]
    if labels:
        nodes.append(helper.make_node('ArgMax', ['logits'], ['labels'], axis=1, keepdims=0))
    _save(path, nodes, (batch, planes, *size), 'labels' if labels else 'logits',
          kind.INT64 if labels else kind.FLOAT,
          {'weights': weights, 'bias': bias.ravel()})
    return str(path)


def map_model(path, output, size=('h', 'w'), takes='float32'):
    """Save a model that always gives this output, whatever it sees."""
    helper, kind = _onnx()
    _save(path, [helper.make_node('Identity', ['map'], ['result'])], (1, 3, *size), 'result',
          helper.np_dtype_to_tensor_dtype(output.dtype), {'map': output},
          kind.UINT8 if takes == 'uint8' else kind.FLOAT)
    return str(path)


def picky_model(path):
    """Save a model that says it takes any size, and does not run at the one it gets."""
    helper, kind = _onnx()
    _save(path, [helper.make_node('Reshape', ['picture', 'shape'], ['result'])],
          (1, 3, 'h', 'w'), 'result', kind.FLOAT, {'shape': np.array([1, 2, 8, 8])})
    return str(path)


def _onnx():
    onnx = pytest.importorskip('onnx')
    pytest.importorskip('onnxruntime')
    return onnx.helper, onnx.TensorProto


def _save(path, nodes, takes, output, kind, constants, picture=1):
    import onnx
    helper = onnx.helper
    graph = helper.make_graph(
        nodes, 'model', [helper.make_tensor_value_info('picture', picture, takes)],
        [helper.make_tensor_value_info(output, kind, None)],
        [onnx.numpy_helper.from_array(np.asarray(value), name)
         for name, value in constants.items()])
    # what older runtimes can load too
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 13)], ir_version=8)
    onnx.save(model, path)
