"""Our own JSON schemas of the objects that we give to KEDA and Kueue.

Written after scaledjob_types.go, scaletriggers_types.go and triggerauthentication_types.go in apis/keda/v1alpha1 and
pkg/scalers/postgresql_scaler.go of https://github.com/kedacore/keda at commit 8b4f083 (August 2026), and after
https://keda.sh/docs/latest/reference/scaledjob-spec. A field that we do not use is left out, so it is refused here.
"""

from __future__ import annotations

from typing import Any

Schema = dict[str, Any]


def _object(required: tuple[str, ...] = (), **properties: Schema) -> Schema:
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def _whole(least: int) -> Schema:
    return {"type": "integer", "minimum": least}


def _one_of(*words: str) -> Schema:
    return {"enum": list(words)}


_TEXT: Schema = {"type": "string", "minLength": 1}
_NUMBER_AS_TEXT: Schema = {"type": "string", "pattern": r"^\d+(\.\d+)?$"}
_METADATA: Schema = {"type": "object"}  # checked as that of a Job

_POSTGRESQL = _object(
    ("type", "metadata", "authenticationRef"),
    type=_one_of("postgresql"),
    metadata=_object(
        ("query", "targetQueryValue"),
        query=_TEXT,
        targetQueryValue=_NUMBER_AS_TEXT,
        activationTargetQueryValue=_NUMBER_AS_TEXT,
    ),
    authenticationRef=_object(("name",), name=_TEXT),
)
SCALED_JOB = _object(
    ("apiVersion", "kind", "metadata", "spec"),
    apiVersion=_one_of("keda.sh/v1alpha1"),
    kind=_one_of("ScaledJob"),
    metadata=_METADATA,
    spec=_object(
        ("jobTargetRef", "triggers"),
        jobTargetRef={"type": "object"},  # a JobSpec: checked with Kubernetes' own schema
        pollingInterval=_whole(1),
        successfulJobsHistoryLimit=_whole(0),
        failedJobsHistoryLimit=_whole(0),
        minReplicaCount=_whole(0),
        maxReplicaCount=_whole(1),
        rollout=_object(
            strategy=_one_of("gradual", "immediate"), propagationPolicy=_one_of("foreground", "background")
        ),
        scalingStrategy=_object(
            strategy=_one_of("default", "custom", "accurate", "eager"),
            pendingPodConditions={"type": "array", "items": _TEXT},
        ),
        triggers={"type": "array", "minItems": 1, "items": _POSTGRESQL},
    ),
)
TRIGGER_AUTHENTICATION = _object(
    ("apiVersion", "kind", "metadata", "spec"),
    apiVersion=_one_of("keda.sh/v1alpha1"),
    kind=_one_of("TriggerAuthentication"),
    metadata=_METADATA,
    spec=_object(
        ("secretTargetRef",),
        secretTargetRef={
            "type": "array",
            "minItems": 1,
            "items": _object(
                ("parameter", "name", "key"),
                parameter=_one_of("connection"),  # of the PostgreSQL scaler
                name=_TEXT,
                key=_TEXT,
            ),
        },
    ),
)

# Kueue's, after apis/kueue/v1beta2 of https://github.com/kubernetes-sigs/kueue at commit 013c8f2.
_KUEUE = {"apiVersion": _one_of("kueue.x-k8s.io/v1beta2"), "metadata": _METADATA}
_QUOTA = _object(("name", "nominalQuota"), name=_TEXT, nominalQuota={"type": ["integer", "string"]})
_FLAVOR = _object(
    ("name", "resources"), name=_TEXT, resources={"type": "array", "minItems": 1, "items": _QUOTA}
)
_GROUP = _object(
    ("coveredResources", "flavors"),
    coveredResources={"type": "array", "minItems": 1, "items": _TEXT},
    flavors={"type": "array", "minItems": 1, "items": _FLAVOR},
)
LOCAL_QUEUE = _object(
    ("apiVersion", "kind", "metadata", "spec"),
    kind=_one_of("LocalQueue"),
    spec=_object(("clusterQueue",), clusterQueue=_TEXT),
    **_KUEUE,
)
CLUSTER_QUEUE = _object(
    ("apiVersion", "kind", "metadata", "spec"),
    kind=_one_of("ClusterQueue"),
    spec=_object(
        ("resourceGroups", "namespaceSelector"),  # without a selector no namespace is let in
        resourceGroups={"type": "array", "minItems": 1, "items": _GROUP},
        namespaceSelector=_object(matchLabels={"type": "object"}),
        cohortName=_TEXT,
    ),
    **_KUEUE,
)
RESOURCE_FLAVOR = _object(("apiVersion", "kind", "metadata"), kind=_one_of("ResourceFlavor"), **_KUEUE)
BY_KIND = {
    "ScaledJob": SCALED_JOB,
    "TriggerAuthentication": TRIGGER_AUTHENTICATION,
    "LocalQueue": LOCAL_QUEUE,
    "ClusterQueue": CLUSTER_QUEUE,
    "ResourceFlavor": RESOURCE_FLAVOR,
}


def workers_to_start(waiting: int, unfinished: int, pending: int, most: int) -> int:
    """How many Jobs KEDA makes in one round of the strategy `accurate`, with a target of one waiting job each.

    After pkg/scaling/executor/scale_jobs.go. ``unfinished`` Jobs include the ``pending`` ones, whose pods do not yet
    fulfil the pendingPodConditions.
    """
    wanted = min(waiting, most)
    enough = most - unfinished if wanted + unfinished - pending > most else wanted - pending
    return max(0, min(wanted, enough))
