"""What deploy/kubernetes promises, read from what kubectl renders; test_kubernetes_pods.py runs its processes."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator, Mapping
from ipaddress import ip_network
from pathlib import Path

import jsonschema
import kubernetes_validate
import pytest
import yaml
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from tests.deploy.custom_schemas import BY_KIND
from tests.deploy.manifests import (
    MANIFESTS,
    OVERLAYS,
    ROOT,
    Manifest,
    container,
    only,
    pod_templates,
    render,
    rendered,
)
from tests.docs.forms_of_commands import command_context
from workers.process.watchdog import STUCK_S
from workers.settings.settings import Settings

PAGE = (ROOT / "docs/kubernetes.md").read_text("utf-8")
# The oldest version that knows all fields, and the newest whose schema there is.
VERSIONS = ("1.30.0", kubernetes_validate.latest_version())
each_overlay = pytest.mark.parametrize("overlay", OVERLAYS)


def violations(manifests: list[Manifest] | tuple[Manifest, ...], version: str) -> Iterator[str]:
    """Where objects differ from the schemas of Kubernetes, KEDA and Kueue."""
    for item in manifests:
        kind = item["kind"]
        checked = item
        if kind in BY_KIND:
            try:
                jsonschema.validate(item, BY_KIND[kind])
            except jsonschema.ValidationError as error:
                yield f"{kind}: {error.message}"
            # What KEDA makes of it: an object with the same metadata, and a Job.
            empty = {"template": {"spec": {"containers": []}}}
            spec = item.get("spec", {}).get("jobTargetRef", empty)
            checked = {"apiVersion": "batch/v1", "kind": "Job", "metadata": item["metadata"], "spec": spec}
        try:
            kubernetes_validate.validate(checked, version, strict=True)
        except kubernetes_validate.ValidationError as error:
            yield f"{kind}: {error.message}"


@each_overlay
@pytest.mark.parametrize("version", VERSIONS)
def test_every_object_is_one_that_the_cluster_knows(overlay: str, version: str):
    assert list(violations(rendered(overlay), version)) == []


def test_the_schemas_find_what_is_wrong():
    (worker,) = [item for item in rendered("cpu") if item["kind"] == "ScaledJob"]
    for change in (
        {"scalingStrategy": {"strategy": "exact"}},
        {"maxReplicas": 3},
        {"triggers": []},
        {"jobTargetRef": {**worker["spec"]["jobTargetRef"], "backofLimit": 0}},
    ):
        assert len(list(violations([{**worker, "spec": {**worker["spec"], **change}}], VERSIONS[0]))) == 1


@each_overlay
def test_every_pod_keeps_the_restricted_standard(overlay: str):
    """https://kubernetes.io/docs/concepts/security/pod-security-standards/#restricted, and a read-only root."""
    for name, template in pod_templates(rendered(overlay)):
        pod, one = template["spec"], container(template)
        assert not {"hostNetwork", "hostPID", "hostIPC", "initContainers"} & set(pod), name
        assert pod["securityContext"]["runAsNonRoot"] is True, name
        assert pod["securityContext"]["runAsUser"] > 0, name
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}, name
        assert one["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }, name
        for volume in pod["volumes"]:
            assert set(volume) - {"name"} <= {"emptyDir", "secret", "configMap", "persistentVolumeClaim"}, (
                name
            )
        assert not any("hostPort" in port for port in one.get("ports", [])), name
        assert pod["automountServiceAccountToken"] is False, name
        assert {"memory"} <= set(one["resources"]["limits"]), name
        assert {"cpu", "memory"} <= set(one["resources"]["requests"]), name
    labels = only(rendered(overlay), "Namespace", "biresnerf")["metadata"]["labels"]
    assert labels["pod-security.kubernetes.io/enforce"] == "restricted"


def test_five_kinds_of_pods_are_made():
    names = {name.removeprefix("biresnerf-") for name, _ in pod_templates(rendered("cpu"))}
    assert names == {"api", "backup", "dispatcher", "migrate", "worker"}


@each_overlay
def test_a_pod_writes_where_the_image_does_and_as_its_user(overlay: str):
    image = (ROOT / "Dockerfile").read_text()
    (user,) = re.findall(r"^USER (\d+):(\d+)$", image, re.MULTILINE)
    (folder,) = re.findall(r"^VOLUME (\S+)$", image, re.MULTILINE)
    for name, template in pod_templates(rendered(overlay)):
        context = template["spec"]["securityContext"]
        assert (str(context["runAsUser"]), str(context["runAsGroup"])) == user, name
        empty = {v["name"] for v in template["spec"]["volumes"] if "emptyDir" in v}
        mounted = {m["mountPath"] for m in container(template)["volumeMounts"] if m["name"] in empty}
        assert mounted == {folder, "/tmp"}, name


@each_overlay
def test_a_worker_is_ready_as_its_image_says(overlay: str):
    (check,) = re.findall(
        r"^HEALTHCHECK .*\\\n +CMD (\[.*\])$", (ROOT / "Dockerfile").read_text(), re.MULTILINE
    )
    worker = dict(pod_templates(rendered(overlay)))["biresnerf-worker"]
    assert container(worker)["readinessProbe"]["exec"]["command"] == json.loads(check)


@each_overlay
def test_what_goes_on_for_ever_is_restarted_once_its_loop_stands_still(overlay: str):
    """But neither at its start nor where it was frozen for less than the process itself allows."""
    pods = dict(pod_templates(rendered(overlay)))
    for name in ("biresnerf-dispatcher", "biresnerf-worker"):
        one = container(pods[name])
        probe = one["livenessProbe"]
        (check,) = re.findall(
            r"HEALTHCHECK [^\[]*CMD (\[.*\])", (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
        )
        assert probe["exec"]["command"] == [*json.loads(check), "live"], name
        assert probe["periodSeconds"] * (probe["failureThreshold"] - 1) >= STUCK_S, name
    assert "httpGet" in container(pods["biresnerf-api"])["livenessProbe"]


def variables(template: Manifest, manifests: tuple[Manifest, ...]) -> Mapping[str, str]:
    """What the container finds in its environment; values that the cluster fills in are empty."""
    one = container(template)
    found: dict[str, str] = {}
    for source in one["envFrom"]:
        found |= only(manifests, "ConfigMap", source["configMapRef"]["name"])["data"]
    return found | {item["name"]: item.get("value", "") for item in one["env"]}


@each_overlay
def test_every_variable_is_a_setting_of_the_service(overlay: str):
    manifests = rendered(overlay)
    for name, template in pod_templates(manifests):
        found = variables(template, manifests)
        others = {key for key in found if not key.startswith("BIRESNERF_")}
        assert others == {"FORWARDED_ALLOW_IPS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"}, name
        given = {}
        for key, value in found.items():
            setting = key.removeprefix("BIRESNERF_").lower()
            if key in others:
                continue
            assert setting.removesuffix("_file") in Settings.model_fields, key
            if not setting.endswith("_file"):
                given[setting] = value
        Settings(**given)  # and its value is one


@each_overlay
def test_secrets_come_as_files_of_the_secrets_that_the_page_makes(overlay: str):
    manifests = rendered(overlay)
    made = {
        name: set(re.findall(r"--from-(?:file|literal)=(\w+)", rest))
        for name, rest in re.findall(r"create secret generic (\S+) ((?:[^\n]*\\\n)*[^\n]*)", PAGE)
    }
    for name, template in pod_templates(manifests):
        (volume,) = [v for v in template["spec"]["volumes"] if "secret" in v]
        (mount,) = [m for m in container(template)["volumeMounts"] if m["name"] == volume["name"]]
        keys = set()
        for key, value in variables(template, manifests).items():
            assert not re.search(r"(PASSWORD|SECRET|TOKEN|KEY|DATABASE_URL)", key) or key.endswith("_FILE")
            if key.endswith("_FILE"):
                folder, _, file = value.rpartition("/")
                assert folder == mount["mountPath"], name
                keys.add(file)
        assert keys == made[volume["secret"]["secretName"]], name
    for item in only(manifests, "TriggerAuthentication", "biresnerf-queue")["spec"]["secretTargetRef"]:
        assert item["key"] in made[item["name"]]


@each_overlay
def test_whatever_is_named_is_there(overlay: str):
    manifests = rendered(overlay)
    pods = [template["metadata"]["labels"] for _, template in pod_templates(manifests)]

    def chosen(selector: Mapping[str, str]) -> int:
        return sum(selector.items() <= labels.items() for labels in pods)

    policies = [item for item in manifests if item["kind"] == "NetworkPolicy"]
    assert [chosen(item["spec"]["podSelector"].get("matchLabels", {})) for item in policies] == [5, 5, 1, 1]
    service = only(manifests, "Service", "biresnerf-api")["spec"]
    budget = only(manifests, "PodDisruptionBudget", "biresnerf-api")["spec"]
    assert chosen(service["selector"]) == chosen(budget["selector"]["matchLabels"]) == 1
    api = only(manifests, "Deployment", "biresnerf-api")["spec"]
    ports = {port["name"] for port in container(api["template"])["ports"]}
    assert {port["targetPort"] for port in service["ports"]} <= ports
    target = only(manifests, "HorizontalPodAutoscaler", "biresnerf-api")["spec"]["scaleTargetRef"]
    assert only(manifests, target["kind"], target["name"])["apiVersion"] == target["apiVersion"]
    assert "replicas" not in api, "an apply would undo what the autoscaler did"
    for trigger in only(manifests, "ScaledJob", "biresnerf-worker")["spec"]["triggers"]:
        only(manifests, "TriggerAuthentication", trigger["authenticationRef"]["name"])


@each_overlay
def test_nobody_is_reached_and_reaches_out_but_as_said(overlay: str):
    policies = [item["spec"] for item in rendered(overlay) if item["kind"] == "NetworkPolicy"]
    (base,) = [item for item in policies if item["podSelector"] == {}]
    assert base["policyTypes"] == ["Ingress", "Egress"]
    assert not {"ingress", "egress"} & set(base)
    for policy in policies:
        public = [
            block for rule in policy.get("egress", []) for block in rule["to"] if "0.0.0.0/0" in str(block)
        ]
        name = policy["podSelector"].get("matchLabels", {}).get("app.kubernetes.io/component")
        assert not public or name == "dispatcher"
    assert sum("ingress" in policy for policy in policies) == 1


@each_overlay
def test_addresses_within_the_cluster_are_reached_where_an_overlay_names_them_alone(overlay: str):
    """Not the cluster's API, nor what else listens in kube-system or in a private network."""
    policy = only(rendered(overlay), "NetworkPolicy", "names-database-and-store")
    names, database, store = policy["spec"]["egress"]
    (pods,) = names["to"]
    assert pods["namespaceSelector"]["matchLabels"] == {"kubernetes.io/metadata.name": "kube-system"}
    assert pods["podSelector"]["matchLabels"] == {"k8s-app": "kube-dns"}
    assert {port["port"] for port in names["ports"]} == {53}
    for rule, port in ((database, 5432), (store, 443)):
        assert [item["port"] for item in rule["ports"]] == [port]
        # Addresses for documentation, RFC 5737: they lead nowhere.
        assert all(
            ip_network(to["ipBlock"]["cidr"]).subnet_of(ip_network("192.0.2.0/24")) for to in rule["to"]
        )


@pytest.mark.anyio
async def test_who_a_client_is_says_the_proxy_and_not_the_client():
    """Of X-Forwarded-For the last address that is no proxy's counts: what stands before it, the client sent."""
    trusted = only(rendered("cpu"), "ConfigMap", "biresnerf-settings")["data"]["FORWARDED_ALLOW_IPS"]
    seen = []

    async def app(scope, receive, send):
        seen.append((scope["client"][0], scope["scheme"]))

    for peer in ("10.42.0.3", "100.64.3.2", "203.0.113.4"):
        headers = [(b"x-forwarded-for", b"6.6.6.6, 198.51.100.7"), (b"x-forwarded-proto", b"https")]
        scope = {"type": "http", "client": (peer, 1), "scheme": "http", "headers": headers}
        await ProxyHeadersMiddleware(app, trusted)(scope, None, None)
    assert seen == [("198.51.100.7", "https")] * 2 + [("203.0.113.4", "http")]


@each_overlay
def test_every_container_runs_a_command_of_ours_and_a_worker_has_time_to_stop(overlay: str):
    for name, template in pod_templates(rendered(overlay)):
        program, *words = container(template)["args"]
        assert program == "biresnerf"
        parsed = command_context(words)
        assert parsed.info_name == name.removeprefix("biresnerf-")
        if parsed.info_name == "worker":
            assert parsed.params["one_job"] is True
            assert parsed.params["slot"] == f"{overlay}0"
            grace_s = template["spec"]["terminationGracePeriodSeconds"]
            assert grace_s > 2 * Settings.model_fields["stop_grace_s"].default


def test_only_the_gpu_overlay_asks_for_a_gpu_and_its_image():
    workers = {name: dict(pod_templates(rendered(name)))["biresnerf-worker"] for name in OVERLAYS}
    asked = {
        name: container(worker)["resources"]["limits"].get("nvidia.com/gpu")
        for name, worker in workers.items()
    }
    assert asked == {"cpu": None, "gpu": "1"}
    images = {name: container(worker)["image"] for name, worker in workers.items()}
    assert images == {"cpu": "biresnerf", "gpu": "biresnerf-cuda"}


def test_the_overlay_of_the_page_renders_with_the_readers_names(tmp_path: Path):
    (text,) = re.findall(r"```yaml\n(apiVersion: kustomize.*?)```", PAGE, re.DOTALL)
    shutil.copytree(MANIFESTS, tmp_path / "kubernetes")
    own = tmp_path / "kubernetes/overlays/mine"
    own.mkdir()
    (own / "kustomization.yaml").write_text(text)
    found = tuple(render(own))
    assert list(violations(found, VERSIONS[1])) == []
    images = {image["name"]: image for image in yaml.safe_load(text)["images"]}
    for name, template in pod_templates(found):
        wanted = images["biresnerf"]
        assert container(template)["image"] == f"{wanted['newName']}@{wanted['digest']}", name
    settings = only(found, "ConfigMap", "biresnerf-settings")["data"]
    assert settings["BIRESNERF_STORAGE_URL"] == "s3://poses/production"
    assert settings["BIRESNERF_AUTH"] == "required"
    _, database, store = only(found, "NetworkPolicy", "names-database-and-store")["spec"]["egress"]
    assert [to["ipBlock"]["cidr"] for rule in (database, store) for to in rule["to"]] == [
        "10.0.8.5/32",
        "10.0.9.0/28",
    ]


@each_overlay
def test_workers_wait_for_what_kueue_grants_them(overlay: str, tmp_path: Path):
    shutil.copytree(MANIFESTS, tmp_path / "kubernetes")
    own = tmp_path / "kubernetes/overlays/mine"
    own.mkdir()
    (line,) = re.findall(r"^components: .*", PAGE, re.MULTILINE)
    kustomization = {"apiVersion": "kustomize.config.k8s.io/v1beta1", "kind": "Kustomization"}
    (own / "kustomization.yaml").write_text(
        yaml.safe_dump({**kustomization, "resources": [f"../{overlay}"], **yaml.safe_load(line)})
    )
    found = tuple(render(own))
    (text,) = re.findall(r"```yaml\n(apiVersion: kueue.*?)```", PAGE, re.DOTALL)
    theirs = tuple(yaml.safe_load_all(text))
    assert list(violations([*found, *theirs], VERSIONS[1])) == []
    worker = only(found, "ScaledJob", "biresnerf-worker")
    queue = only(found, "LocalQueue", worker["metadata"]["labels"]["kueue.x-k8s.io/queue-name"])
    assert queue["metadata"]["namespace"] == worker["metadata"]["namespace"]
    cluster = only(theirs, "ClusterQueue", queue["spec"]["clusterQueue"])["spec"]
    (namespace,) = [item["metadata"] for item in found if item["kind"] == "Namespace"]
    assert cluster["namespaceSelector"]["matchLabels"] == {"kubernetes.io/metadata.name": namespace["name"]}
    (group,) = cluster["resourceGroups"]
    resources = container(dict(pod_templates(found))["biresnerf-worker"])["resources"]
    # A Job that asks for anything else is never admitted. What is limited and not requested counts as requested.
    assert set(resources["requests"]) | set(resources["limits"]) <= set(group["coveredResources"])
    for flavor in group["flavors"]:
        only(theirs, "ResourceFlavor", flavor["name"])
        assert [one["name"] for one in flavor["resources"]] == group["coveredResources"]
