// The page of one job for somebody with a link: it can be looked at, and its files taken, until the link expires.
import { useEffect } from "preact/hooks";
import type { LinkView } from "schemas";
import { once, useLoaded } from "../api/hooks";
import { apiKey, requestJson, setLink } from "../api/http";
import { useStore } from "../api/store";
import { moment } from "../parts/format";
import { JobPage } from "./page";

export function SharedPage({ id, token }: { id: string; token: string }) {
  const ready = useStore(apiKey) === token; // before that, requests would carry the key
  useEffect(() => {
    setLink(token);
    return () => setLink(null);
  }, [token]);
  return ready ? <Shown id={id} /> : null;
}

function Shown({ id }: { id: string }) {
  const { value: link, problem } = useLoaded((signal) => requestJson<LinkView>("GET", `v1/jobs/${id}/link`, { signal }), once, [id]);
  if (problem?.status === 401 || problem?.status === 404) {
    return (
      <div class="problem" role="alert">
        <h3>This link opens nothing</h3>
        <p>It has expired or was revoked.</p>
        <p>
          <strong>What to do:</strong> ask whoever sent it for a new one.
        </p>
      </div>
    );
  }
  return (
    <>
      {link && <p class="soft">Shared with you. This page can be seen until {moment(link.expires_at)}.</p>}
      {link && <JobPage id={id} />}
    </>
  );
}
