"""The command that serves: a policy of ours, or the prompting proxy before another's server."""

import asyncio
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from vap_core.cli.command import BANK, Memory, ObjectNames, Speaker, StackName, takes

if TYPE_CHECKING:
    from vap_core.policies.wires import Wire
    from vap_core.serve.server import PolicyServer

app = typer.Typer()


@dataclass(frozen=True)
class AskedOfServe:
    """The options of serve."""

    upstream: Annotated[
        str | None,
        typer.Option(
            metavar="ws://HOST:PORT",
            help="The policy server behind; what clients observe is prompted on the way. A token "
            "that it wants stands in VAP_UPSTREAM_TOKEN.",
        ),
    ] = None
    policy: Annotated[
        str | None,
        typer.Option(
            help="Serve this instead: a lerobot checkpoint, as folder or hub id; or, with --suite, "
            "mini-pi0 or scripted."
        ),
    ] = None
    suite: Annotated[str, typer.Option(help="The suite that the policy is for.")] = ""
    wire: Annotated[
        Literal["openpi", "vla-eval"], typer.Option(help="What clients and servers speak.")
    ] = "openpi"
    wire_map: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE.json",
            help="What clients of --policy call pictures, state and command. Default ours, or "
            "ours-vla-eval.",
        ),
    ] = ""
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 8001
    host: Annotated[
        str,
        typer.Option(help="Where to listen; another address than this needs a token in VAP_TOKEN."),
    ] = "127.0.0.1"
    memory: Memory = BANK
    object: ObjectNames = None
    speaker: Speaker = ""
    stack: StackName = "embedded"
    camera: Annotated[
        list[str] | None,
        typer.Option(help="Key of a picture to prompt, as a/b; repeatable. Default all."),
    ] = None
    new_episode: Annotated[
        Literal["auto", "prompt", "connection", "never"],
        typer.Option(
            help="When an episode starts beside a message that says so: at another command, or "
            "where the robot or every view jumps (auto); at another command alone (prompt); with "
            "a connection alone, another command refused (connection) or not looked at (never)."
        ),
    ] = "auto"
    dry: Annotated[
        bool, typer.Option("--dry", help="Prompt nothing: with --record a flight recorder.")
    ] = False
    record: Annotated[
        Path | None,
        typer.Option(help="Folder for a recording of every episode, and tables for query."),
    ] = None


@app.command()
@takes(AskedOfServe)
def serve(asked: AskedOfServe) -> None:
    """Stand between any client and any policy server, and prompt what passes; or serve a policy.
    Ctrl-C ends it.

    Example: ./vap serve --upstream ws://gpu:8000 --memory data/memory
        --record data/runs/served
    Example: ./vap serve --upstream ws://gpu:8000 --dry --record data/runs/flight
    Example: ./vap serve --policy mini-pi0 --suite simpler-bridge --port 8000
    """
    from vap_core.base.errors import BadStudy
    from vap_core.policies.wires import wire_of

    if (asked.upstream is None) == (asked.policy is None):
        raise BadStudy("serve: name --upstream ws://HOST:PORT, or --policy NAME; one of the two.")
    wire = wire_of(asked.wire)
    if asked.policy is not None:
        asyncio.run(_listen(asked, wire, _policy_server(asked, wire), asked.policy))
        return
    assert asked.upstream is not None
    _proxy(asked, wire, asked.upstream)


def _policy_server(asked: AskedOfServe, wire: "Wire") -> "PolicyServer":
    from vap_core.policies.names import POLICIES
    from vap_core.policies.wire_map import OURS, load_map
    from vap_core.serve.server import PolicyServer

    assert asked.policy is not None
    convention = load_map(asked.wire_map or OURS[wire.name])
    if asked.suite:
        from vap_core.simulation import suites
        from vap_core.study.trials import Study, make_trial

        task = suites.tasks_of([asked.suite], "")[0]
        study = Study((task,), ("generic",), policy=asked.policy, stack=asked.stack)
        trial = make_trial(study, study.rows(*task), "generic", asked.memory)
        policy: Any = trial.policy
        return PolicyServer(policy, convention, suites.suite(asked.suite).cameras)
    if asked.policy in (*POLICIES, "mini-pi0"):
        from vap_core.base.errors import BadStudy

        raise BadStudy(f"serve: {asked.policy} is for one suite; name it by --suite.")
    from vap_core.policies.lerobot.adapter import load_policy

    loaded = load_policy(asked.policy)
    return PolicyServer(loaded, convention, loaded.cameras())


def _proxy(asked: AskedOfServe, wire: "Wire", upstream: str) -> None:
    from vap_core.attend import Attender
    from vap_core.base.errors import command
    from vap_core.memory import load_bank
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.served import parse_address
    from vap_core.serve.proxy import Options, Proxy
    from vap_core.serve.records import Records

    url = parse_address(upstream).url
    attender, bank = None, {}
    if not asked.dry:
        print("loading the perception stack ...", file=sys.stderr)
        models = load_stack(asked.stack)
        bank = load_bank(asked.memory, models.encoder.name, "serve")
        attender = Attender(models, bank, speaker=asked.speaker)
    about = {"method": "dry" if asked.dry else "vap", "policy": url, "wire": wire.name}
    options = Options(
        cameras=tuple(asked.camera or ()),
        new_episode=asked.new_episode,
        objects=None if asked.object is None else tuple(asked.object),
    )
    proxy = Proxy(url, attender, options, Records(asked.record, bank, about))
    objects = ", ".join(bank) or "nothing"
    asyncio.run(_listen(asked, wire, proxy, f"a proxy before {url}; it remembers {objects}"))
    if asked.record is not None:
        print("next: " + command("query", asked.record, "lost-track"))


async def _listen(asked: AskedOfServe, wire: "Wire", handler: Any, what: str) -> None:
    from functools import partial

    from vap_core.serve.server import listen

    def ready(port: int) -> None:
        place = f"ws://{asked.host}:{port}"
        print(f"serving {what} at {place} ({wire.name}); Ctrl-C ends it", flush=True)

    await listen(partial(handler, wire=wire), wire, asked.port, asked.host, ready)
