// Links that show this page to others: created, listed, revoked.
import { useState } from "preact/hooks";
import type { JobView, LinkList, LinkView, NewLinkView } from "schemas";
import { Pick } from "../../../biresnerf/viewer/widgets/controls";
import { useAttempt, useLoaded, once } from "../api/hooks";
import { address, requestJson } from "../api/http";
import { CopyButton } from "../parts/copy_button";
import { DialogButton } from "../parts/dialog_button";
import { moment } from "../parts/format";
import { ProblemBox } from "../parts/problem_box";

const DAY_S = 86_400;
const TIMES = [
  { value: DAY_S, text: "1 day" },
  { value: 7 * DAY_S, text: "7 days" },
  { value: 30 * DAY_S, text: "30 days" },
  { value: 90 * DAY_S, text: "90 days" },
];

export function Share({ job }: { job: JobView }) {
  return (
    <DialogButton button="Share" title="Share this page" choices={[]} dismiss="Close">
      {() => <Links job={job} />}
    </DialogButton>
  );
}

function Links({ job }: { job: JobView }) {
  const path = `v1/jobs/${job.id}/links`;
  const [valid, setValid] = useState(7 * DAY_S);
  const [made, setMade] = useState<NewLinkView | null>(null);
  const [version, setVersion] = useState(0);
  const { attempt, busy, problem } = useAttempt();
  const { value: links } = useLoaded((signal) => requestJson<LinkList>("GET", path, { signal }), once, [path, version]);
  const create = () =>
    attempt(async () => {
      setMade(await requestJson<NewLinkView>("POST", path, { json: { valid_s: valid } }));
      setVersion((n) => n + 1);
    });
  const revoke = (link: LinkView) =>
    attempt(async () => {
      await requestJson("DELETE", `${path}/${link.id}`);
      if (made?.id === link.id) setMade(null);
      setVersion((n) => n + 1);
    });
  return (
    <>
      <p>Whoever has the link sees this job and takes its files, without a key. Nothing else is shown, and nothing can be changed.</p>
      <p class="share-new">
        <Pick label="Valid for" value={valid} onChange={setValid} options={TIMES} />
        <button type="button" class="act primary" disabled={busy} onClick={create}>
          Create a link
        </button>
      </p>
      {made && (
        <p class="share-new">
          <input type="text" readOnly aria-label="Link to this page" value={address(made.page)} onFocus={(event) => event.currentTarget.select()} />
          <CopyButton text={address(made.page)} what="the link" />
          <span class="soft">It is shown only now.</span>
        </p>
      )}
      {links && links.items.length > 0 && (
        <ul class="share-links" aria-label="Links to this page">
          {links.items.map((link) => (
            <li key={link.id}>
              <span>
                Until {moment(link.expires_at)} <span class="soft">created {moment(link.created_at)}</span>
              </span>
              <button type="button" class="act small" disabled={busy} aria-label={`Revoke the link until ${moment(link.expires_at)}`} onClick={() => revoke(link)}>
                Revoke
              </button>
            </li>
          ))}
        </ul>
      )}
      {problem && <ProblemBox problem={problem} />}
    </>
  );
}
